// Python's side of csrc/train.h: the classes of the fused training step.

#include "bindings.h"

// the weights of a struct's own Regularizers, as fields of the struct
template <class Struct>
static void regularizers(nb::class_<Struct>& type) {
    const auto field = [&type](const char* name, float Regularizers::*weight) {
        type.def_prop_rw(
            name, [weight](const Struct& s) { return s.own.*weight; },
            [weight](Struct& s, float value) { s.own.*weight = value; });
    };
    field("entropy", &Regularizers::entropy);
    field("opacity", &Regularizers::opacity);
    field("scale", &Regularizers::scale);
}

void bind_training(nb::module_& m) {
    nb::class_<LossSettings> settings(m, "LossSettings", nb::dynamic_attr());
    settings.def(nb::init<>());
    settings.def("set_pixelwise", [](LossSettings& s, bool l1) { s.pixelwise = l1 ? Pixelwise::l1 : Pixelwise::l2; });
    VALUE(settings, LossSettings, pixelwise_weight);
    VALUE(settings, LossSettings, ssim_weight);
    VALUE(settings, LossSettings, margin);

    nb::class_<Photographs> photographs(m, "Photographs", nb::dynamic_attr());
    photographs.def(nb::init<>());
    POINTER(photographs, Photographs, images);
    POINTER(photographs, Photographs, masks);
    POINTER(photographs, Photographs, shares);
    POINTER(photographs, Photographs, moments);

    nb::class_<LossArrays> loss(m, "LossArrays", nb::dynamic_attr());
    loss.def(nb::init<>());
    POINTER(loss, LossArrays, image);
    POINTER(loss, LossArrays, windows);
    POINTER(loss, LossArrays, partials);
    POINTER(loss, LossArrays, values);
    POINTER(loss, LossArrays, v_image);
    VALUE(loss, LossArrays, width);
    VALUE(loss, LossArrays, height);

    nb::class_<Schedule> schedule(m, "Schedule", nb::dynamic_attr());
    schedule.def(nb::init<>());
    POINTER(schedule, Schedule, views);
    POINTER(schedule, Schedule, viewmats);
    POINTER(schedule, Schedule, Ks);
    POINTER(schedule, Schedule, viewmat);
    POINTER(schedule, Schedule, K);
    POINTER(schedule, Schedule, rates);
    POINTER(schedule, Schedule, numbers);
    VALUE(schedule, Schedule, n_views);
    VALUE(schedule, Schedule, place);
    VALUE(schedule, Schedule, beta1);
    VALUE(schedule, Schedule, beta2);
    VALUE(schedule, Schedule, eps);

    nb::class_<StepRecord> record(m, "StepRecord", nb::dynamic_attr());
    record.def(nb::init<>());
    POINTER(record, StepRecord, values);
    POINTER(record, StepRecord, history);
    POINTER(record, StepRecord, pop_sums);
    VALUE(record, StepRecord, n);
    VALUE(record, StepRecord, lambda_pop);

    nb::class_<PopTerm> term(m, "PopTerm", nb::dynamic_attr());
    term.def(nb::init<>());
    VALUE(term, PopTerm, n);
    POINTER(term, PopTerm, dominant_counts);
    POINTER(term, PopTerm, window_counts);
    POINTER(term, PopTerm, radii);
    POINTER(term, PopTerm, logits);
    POINTER(term, PopTerm, log_scales);
    regularizers(term);
    POINTER(term, PopTerm, sides);
    POINTER(term, PopTerm, sums);

    nb::class_<UpdateArrays> update(m, "UpdateArrays", nb::dynamic_attr());
    update.def(nb::init<>());
    VALUE(update, UpdateArrays, n);
    VALUE(update, UpdateArrays, n_rest);
    VALUE(update, UpdateArrays, n_views);
    VALUE(update, UpdateArrays, place);
    VALUE(update, UpdateArrays, lambda_pop);
    regularizers(update);
    VALUE(update, UpdateArrays, blur_own_view);
    POINTER(update, UpdateArrays, constants);
    POINTER(update, UpdateArrays, sh_rest_sum);
    POINTER(update, UpdateArrays, sums);
    POINTER(update, UpdateArrays, dominant_counts);
    POINTER(update, UpdateArrays, pop_sides);
    POINTER(update, UpdateArrays, grad_sum);
    POINTER(update, UpdateArrays, n_visible);
    POINTER(update, UpdateArrays, dominant_sum);
    POINTER(update, UpdateArrays, blur_pixels);
    POINTER(update, UpdateArrays, blurred);
    update.def(
        "set_group",
        [](UpdateArrays& s, int group, uintptr_t param, uintptr_t m, uintptr_t v, uintptr_t gradient) {
            s.groups[group] = {reinterpret_cast<float*>(param), reinterpret_cast<float*>(m),
                               reinterpret_cast<float*>(v), reinterpret_cast<float*>(gradient)};
        },
        nb::arg("group"), nb::arg("param"), nb::arg("m"), nb::arg("v"), nb::arg("gradient") = 0);
}
