// The kernels' host functions for Python: structs of pointers and numbers, no mathematics, no torch.
//
// Pointers cross as integers (tensor.data_ptr()); cuda_ext.arrays checks device, type, shape and contiguity before it takes one.
// Every class takes attributes of its own, so that Python can keep the tensors alive whose addresses it holds.

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include <type_traits>

#include "csrc/train.h"

namespace nb = nanobind;
using namespace pop;

namespace {

cudaStream_t as_stream(uintptr_t stream) { return reinterpret_cast<cudaStream_t>(stream); }

DeviceState* as_state(uintptr_t state) { return reinterpret_cast<DeviceState*>(state); }

// torch's name for what a field points to, so that Python can refuse a tensor of another type
template <class T>
constexpr const char* dtype_of() {
    using Value = std::remove_cv_t<T>;
    constexpr bool ints = std::is_same_v<Value, int> || std::is_same_v<Value, unsigned> ||
                          std::is_same_v<Value, DeviceState>;
    constexpr bool floats = std::is_same_v<Value, float> || std::is_same_v<Value, StepConstants>;
    constexpr bool doubles = std::is_same_v<Value, double>;
    constexpr bool bytes = std::is_same_v<Value, uint8_t>;
    // a pointer to pointers is a table of addresses; void is for tile keys, of which there are two kinds
    constexpr bool addresses = std::is_pointer_v<Value>, keys = std::is_void_v<Value>;
    static_assert(ints || floats || doubles || bytes || addresses || keys, "give this field's type its torch dtype");
    if (doubles) return "float64";
    return ints ? "int32" : floats ? "float32" : bytes ? "uint8" : addresses ? "int64" : "int16 int32";
}

// the class keeps the type of each of its pointers in `dtypes`
template <class Struct, class Pointer>
void note_dtype(nb::class_<Struct>& type, const char* name, Pointer) {
    if (!nb::hasattr(type, "dtypes")) type.attr("dtypes") = nb::dict();
    nb::cast<nb::dict>(type.attr("dtypes"))[name] = dtype_of<std::remove_pointer_t<Pointer>>();
}

// a pointer as a property that reads and writes integers
template <class Struct, class Pointer>
void pointer(nb::class_<Struct>& type, const char* name, Pointer Struct::* member) {
    note_dtype(type, name, Pointer());
    type.def_prop_rw(
        name, [member](const Struct& s) { return reinterpret_cast<uintptr_t>(s.*member); },
        [member](Struct& s, uintptr_t value) { s.*member = reinterpret_cast<Pointer>(value); });
}

// one of the two buffers of a sort
template <class Struct, class Pointer>
void pointer_pair(nb::class_<Struct>& type, const char* first, const char* second, Pointer (Struct::*member)[2]) {
    const char* names[2] = {first, second};
    for (int k = 0; k < 2; ++k) {
        note_dtype(type, names[k], Pointer());
        type.def_prop_rw(
            names[k], [member, k](const Struct& s) { return reinterpret_cast<uintptr_t>((s.*member)[k]); },
            [member, k](Struct& s, uintptr_t value) { (s.*member)[k] = reinterpret_cast<Pointer>(value); });
    }
}

#define POINTER(type, Struct, name) pointer(type, #name, &Struct::name)
#define VALUE(type, Struct, name) type.def_rw(#name, &Struct::name)

// ---- csrc/launch.h

void bind_view(nb::module_& m) {
    nb::class_<Profile<float>> profile(m, "Profile", nb::dynamic_attr());
    profile.def(nb::init<>());
    VALUE(profile, Profile<float>, near_plane);
    VALUE(profile, Profile<float>, far_plane);
    VALUE(profile, Profile<float>, eps2d);
    VALUE(profile, Profile<float>, frustum_margin);
    VALUE(profile, Profile<float>, extent_sigmas);
    VALUE(profile, Profile<float>, alpha_floor);
    VALUE(profile, Profile<float>, alpha_ceiling);
    VALUE(profile, Profile<float>, transmittance_stop);
    VALUE(profile, Profile<float>, tile_size);
    VALUE(profile, Profile<float>, near_inclusive);
    VALUE(profile, Profile<float>, centred);
    VALUE(profile, Profile<float>, inria_clamp);
    VALUE(profile, Profile<float>, square);
    VALUE(profile, Profile<float>, pass_ceiling);
    VALUE(profile, Profile<float>, stop_inclusive);

    nb::class_<ViewArrays> view(m, "View", nb::dynamic_attr());
    view.def(nb::init<>());
    POINTER(view, ViewArrays, viewmat);
    POINTER(view, ViewArrays, K);
    VALUE(view, ViewArrays, width);
    VALUE(view, ViewArrays, height);

    nb::class_<ProjectSettings> settings(m, "ProjectSettings", nb::dynamic_attr());
    settings.def(nb::init<>());
    VALUE(settings, ProjectSettings, profile);
    VALUE(settings, ProjectSettings, sh_degree);
    settings.def_prop_rw(
        "antialiased", [](const ProjectSettings& s) { return s.options.antialiased; },
        [](ProjectSettings& s, bool value) { s.options.antialiased = value; });
    settings.def_prop_rw(
        "radius_clip", [](const ProjectSettings& s) { return s.options.radius_clip; },
        [](ProjectSettings& s, float value) { s.options.radius_clip = value; });
}

void bind_rows(nb::module_& m) {
    nb::class_<GaussianArrays> gaussians(m, "Gaussians", nb::dynamic_attr());
    gaussians.def(nb::init<>());
    VALUE(gaussians, GaussianArrays, n);
    POINTER(gaussians, GaussianArrays, means);
    POINTER(gaussians, GaussianArrays, quats);
    POINTER(gaussians, GaussianArrays, scales);
    POINTER(gaussians, GaussianArrays, opacities);
    POINTER(gaussians, GaussianArrays, sh_first);
    POINTER(gaussians, GaussianArrays, sh_rest);
    VALUE(gaussians, GaussianArrays, sh_first_stride);
    VALUE(gaussians, GaussianArrays, sh_rest_stride);
    VALUE(gaussians, GaussianArrays, raw);

    nb::class_<SplatArrays> splats(m, "Splats", nb::dynamic_attr());
    splats.def(nb::init<>());
    POINTER(splats, SplatArrays, means2d);
    POINTER(splats, SplatArrays, depths);
    POINTER(splats, SplatArrays, conics);
    POINTER(splats, SplatArrays, opacities);
    POINTER(splats, SplatArrays, colors);
    POINTER(splats, SplatArrays, radii);
    POINTER(splats, SplatArrays, records);

    nb::class_<SplatGradients> of_splats(m, "SplatGradients", nb::dynamic_attr());
    of_splats.def(nb::init<>());
    POINTER(of_splats, SplatGradients, v_means2d);
    POINTER(of_splats, SplatGradients, v_means2d_abs);
    POINTER(of_splats, SplatGradients, v_conics);
    POINTER(of_splats, SplatGradients, v_opacities);
    POINTER(of_splats, SplatGradients, v_colors);

    nb::class_<GaussianGradients> of_gaussians(m, "GaussianGradients", nb::dynamic_attr());
    of_gaussians.def(nb::init<>());
    POINTER(of_gaussians, GaussianGradients, v_means);
    POINTER(of_gaussians, GaussianGradients, v_quats);
    POINTER(of_gaussians, GaussianGradients, v_scales);
    POINTER(of_gaussians, GaussianGradients, v_opacities);
    POINTER(of_gaussians, GaussianGradients, v_sh);
    VALUE(of_gaussians, GaussianGradients, sh_stride);
    POINTER(of_gaussians, GaussianGradients, v_viewmat);
}

void bind_blend(nb::module_& m) {
    nb::class_<TileLists> lists(m, "TileLists", nb::dynamic_attr());
    lists.def(nb::init<>());
    VALUE(lists, TileLists, n);
    VALUE(lists, TileLists, capacity);
    VALUE(lists, TileLists, n_tiles);
    VALUE(lists, TileLists, exact);
    lists.def("set_grid", [](TileLists& s, int width, int height, int tile_w, int tile_h) {
        s.grid = grid_of(width, height, tile_w, tile_h);
        s.n_tiles = s.grid.tiles_x * s.grid.tiles_y;
    });
    pointer_pair(lists, "depth_keys", "depth_keys_sorted", &TileLists::depth_keys);
    pointer_pair(lists, "order_unsorted", "order", &TileLists::order);
    pointer_pair(lists, "tile_keys", "tile_keys_sorted", &TileLists::tile_keys);
    pointer_pair(lists, "slots_unsorted", "slots", &TileLists::slots);
    POINTER(lists, TileLists, hits);
    POINTER(lists, TileLists, slot_splat);
    POINTER(lists, TileLists, listed);
    POINTER(lists, TileLists, tile_begin);
    POINTER(lists, TileLists, tile_end);
    POINTER(lists, TileLists, tile_order);
    POINTER(lists, TileLists, splat_begin);
    POINTER(lists, TileLists, splat_count);
    POINTER(lists, TileLists, bucket_begin);
    POINTER(lists, TileLists, bucket_tile);
    POINTER(lists, TileLists, workspace);
    VALUE(lists, TileLists, workspace_bytes);

    nb::class_<BlendForward> forward(m, "BlendForward", nb::dynamic_attr());
    forward.def(nb::init<>());
    VALUE(forward, BlendForward, channels);
    POINTER(forward, BlendForward, records);
    POINTER(forward, BlendForward, background);
    POINTER(forward, BlendForward, image);
    POINTER(forward, BlendForward, T_final);
    POINTER(forward, BlendForward, last);
    POINTER(forward, BlendForward, checkpoints);
    POINTER(forward, BlendForward, dominant_ids);
    POINTER(forward, BlendForward, dominant_weights);
    POINTER(forward, BlendForward, n_blended);
    POINTER(forward, BlendForward, n_traversed);
    POINTER(forward, BlendForward, dominant_counts);
    POINTER(forward, BlendForward, masks);
    POINTER(forward, BlendForward, state);

    nb::class_<BlendBackward> backward(m, "BlendBackward", nb::dynamic_attr());
    backward.def(nb::init<>());
    VALUE(backward, BlendBackward, channels);
    VALUE(backward, BlendBackward, absolute);
    backward.def("set_backward", [](BlendBackward& s, bool splats, bool atomics) {
        s.backward = splats ? Backward::gaussian_parallel : Backward::pixel_parallel;
        s.gather = atomics ? Gather::atomics : Gather::slots;
    });
    POINTER(backward, BlendBackward, records);
    POINTER(backward, BlendBackward, background);
    POINTER(backward, BlendBackward, image);
    POINTER(backward, BlendBackward, T_final);
    POINTER(backward, BlendBackward, last);
    POINTER(backward, BlendBackward, checkpoints);
    POINTER(backward, BlendBackward, v_image);
    POINTER(backward, BlendBackward, v_T_final);
    POINTER(backward, BlendBackward, rows);
    POINTER(backward, BlendBackward, sums);

    nb::class_<ScoreArrays> scores(m, "Scores", nb::dynamic_attr());
    scores.def(nb::init<>());
    POINTER(scores, ScoreArrays, records);
    POINTER(scores, ScoreArrays, background);
    POINTER(scores, ScoreArrays, T_final);
    POINTER(scores, ScoreArrays, last);
    POINTER(scores, ScoreArrays, pixel_map);
    VALUE(scores, ScoreArrays, fx);
    VALUE(scores, ScoreArrays, fy);
    VALUE(scores, ScoreArrays, cx);
    VALUE(scores, ScoreArrays, cy);
    POINTER(scores, ScoreArrays, rows);
    POINTER(scores, ScoreArrays, totals);
    POINTER(scores, ScoreArrays, ids);
}

// ---- csrc/train.h: the fused training step

// the weights of a struct's own Regularizers, as fields of the struct
template <class Struct>
void regularizers(nb::class_<Struct>& type) {
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

// ---- functions

void bind_functions(nb::module_& m) {
    using P = uintptr_t;
    m.def("project", [](const GaussianArrays& g, const ViewArrays& v, const ProjectSettings& s, const SplatArrays& out,
                        P state, P stream) { project(g, v, s, out, as_state(state), as_stream(stream)); });
    m.def("pack_records", [](int n, int channels, const SplatArrays& s, float alpha_floor, P records, P stream) {
        pack_records(n, channels, s, alpha_floor, reinterpret_cast<float*>(records), as_stream(stream));
    });
    m.def("tile_workspace", &tile_workspace);
    m.def("hit_words", &hit_words);
    m.def("sort_by_depth", [](const TileLists& l, const SplatArrays& s, P stream) {
        sort_by_depth(l, s, as_stream(stream));
    });
    m.def("count_tiles", [](const TileLists& l, const SplatArrays& s, const Profile<float>& p, P stream) {
        count_tiles(l, s, p, as_stream(stream));
    });
    m.def("number_instances", [](const TileLists& l, P state, P stream) {
        number_instances(l, as_state(state), as_stream(stream));
    });
    m.def("make_tile_lists", [](const TileLists& l, const SplatArrays& s, const Profile<float>& p, P dominant_counts,
                                P state, P stream) {
        make_tile_lists(l, s, p, reinterpret_cast<int*>(dominant_counts), as_state(state), as_stream(stream));
    });
    m.def("blend_forward", [](const TileLists& l, const BlendForward& b, const Profile<float>& p, P stream) {
        blend_forward(l, b, p, as_stream(stream));
    });
    m.def("blend_backward", [](const TileLists& l, const BlendBackward& b, const Profile<float>& p, P state, P stream) {
        blend_backward(l, b, p, as_state(state), as_stream(stream));
    });
    m.def("score_columns", [](int score) { return score_columns(Score(score)); });
    m.def("score_pitch", [](int score) { return score_pitch(Score(score)); });
    m.def("score_view", [](const TileLists& l, const ScoreArrays& s, int score, const Profile<float>& p, P stream) {
        score_view(l, s, Score(score), p, as_stream(stream));
    });
    m.def("splat_gradients", [](int n, int channels, const SplatArrays& s, P sums, const SplatGradients& g, P stream) {
        splat_gradients(n, channels, s, reinterpret_cast<const float*>(sums), g, as_stream(stream));
    });
    m.def("project_backward",
          [](const GaussianArrays& g, const ViewArrays& v, const ProjectSettings& s, const SplatArrays& splats,
             const SplatGradients& of, P v_depths, const GaussianGradients& out, P stream) {
              project_backward(g, v, s, splats, of, reinterpret_cast<const float*>(v_depths), out, as_stream(stream));
          });
    m.def("loss_blocks", &loss_blocks);
    m.def("target_moments", [](const Photographs& p, const LossArrays& l, const LossSettings& s, P state, P stream) {
        target_moments(p, l, s, as_state(state), as_stream(stream));
    });
    m.def("photometric", [](const Photographs& p, const LossArrays& l, const LossSettings& s, P state, P stream) {
        photometric(p, l, s, as_state(state), as_stream(stream));
    });
    m.def("begin_step", [](const Schedule& s, P constants, P state, P stream) {
        begin_step(s, reinterpret_cast<StepConstants*>(constants), as_state(state), as_stream(stream));
    });
    m.def("important_blocks", &important_blocks);
    m.def("count_important", [](const PopTerm& term, P state, P stream) {
        count_important(term, as_state(state), as_stream(stream));
    });
    m.def("update", [](const UpdateArrays& a, const ViewArrays& v, const ProjectSettings& s, const SplatArrays& splats,
                       P state, P stream) { update(a, v, s, splats, as_state(state), as_stream(stream)); });
    m.def("end_step", [](const StepRecord& record, P state, P stream) {
        end_step(record, as_state(state), as_stream(stream));
    });
    m.def("clear", [](P data, size_t bytes, P stream) {
        POP_CUDA(cudaMemsetAsync(reinterpret_cast<void*>(data), 0, bytes, as_stream(stream)));
    });
    // the newest CUDA that the driver knows, 0 where there is no driver
    m.def("driver_version", []() {
        int version = 0;
        POP_CUDA(cudaDriverGetVersion(&version));
        return version;
    });
}

}  // namespace

NB_MODULE(_kernels, m) {
    bind_view(m);
    bind_rows(m);
    bind_blend(m);
    bind_training(m);
    bind_functions(m);
    m.attr("RECORD") = RECORD;
    m.attr("TILE_PIXELS") = TILE_PIXELS;
    m.attr("PROJECT_BLOCK") = PROJECT_BLOCK;
    m.attr("STATE_INTS") = int(sizeof(DeviceState) / sizeof(int));
    m.attr("N_VALUES") = int(N_VALUES);
    m.attr("STEP_CONSTANTS_FLOATS") = int(sizeof(StepConstants) / sizeof(float));
    // what the kernels were compiled for, so that another card gets a sentence instead of a launch error
    m.attr("ARCHS") = POP_CUDA_ARCHS;
    m.attr("RUNTIME") = CUDART_VERSION;
}
