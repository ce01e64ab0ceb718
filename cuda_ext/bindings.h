// How structs of pointers become Python classes. Every class takes attributes of its own, so that Python can keep the
// tensors alive whose addresses it holds.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include <type_traits>

#include "csrc/train.h"

namespace nb = nanobind;
using namespace pop;

inline cudaStream_t as_stream(uintptr_t stream) { return reinterpret_cast<cudaStream_t>(stream); }

inline DeviceState* as_state(uintptr_t state) { return reinterpret_cast<DeviceState*>(state); }

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

// the classes of the fused step, in bindings_training.cpp
void bind_training(nb::module_& m);
