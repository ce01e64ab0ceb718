// How structs of pointers become Python classes. Every class takes attributes of its own, so that Python can keep the
// tensors alive whose addresses it holds.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include "csrc/train.h"

namespace nb = nanobind;
using namespace pop;

inline cudaStream_t as_stream(uintptr_t stream) { return reinterpret_cast<cudaStream_t>(stream); }

inline DeviceState* as_state(uintptr_t state) { return reinterpret_cast<DeviceState*>(state); }

// a pointer as a property that reads and writes integers
template <class Struct, class Pointer>
void pointer(nb::class_<Struct>& type, const char* name, Pointer Struct::* member) {
    type.def_prop_rw(
        name, [member](const Struct& s) { return reinterpret_cast<uintptr_t>(s.*member); },
        [member](Struct& s, uintptr_t value) { s.*member = reinterpret_cast<Pointer>(value); });
}

// one of the two buffers of a sort
template <class Struct, class Pointer>
void pointer_pair(nb::class_<Struct>& type, const char* first, const char* second, Pointer (Struct::*member)[2]) {
    const char* names[2] = {first, second};
    for (int k = 0; k < 2; ++k)
        type.def_prop_rw(
            names[k], [member, k](const Struct& s) { return reinterpret_cast<uintptr_t>((s.*member)[k]); },
            [member, k](Struct& s, uintptr_t value) { (s.*member)[k] = reinterpret_cast<Pointer>(value); });
}

#define POINTER(type, Struct, name) pointer(type, #name, &Struct::name)
#define VALUE(type, Struct, name) type.def_rw(#name, &Struct::name)

// the classes of the fused step, in bindings_training.cpp
void bind_training(nb::module_& m);
