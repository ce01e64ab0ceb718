// The kernels' mathematics looped on the host, in float and in double, behind one C entry point a precision.
//
// It includes the very headers that the kernels include, so that a machine without a GPU can hold them to the laws.
// Built by cuda_ext.host.mirror.build_mirror with any C++17 compiler; nothing but tests loads it.

#include <string.h>

#include "mirror_render.h"
#include "mirror_stages.h"

namespace pop {
namespace mirror {

template <class Real>
int call(const char* name, Arguments<Real>* arguments) {
    for (const Entry<Real>* table : {stage_table<Real>(), render_table<Real>()})
        for (; table->name != nullptr; ++table)
            if (strcmp(table->name, name) == 0) {
                table->run(*arguments);
                return 0;
            }
    return 1;
}

}  // namespace mirror
}  // namespace pop

// 0 where done, 1 where the name is unknown
extern "C" int pop_mirror_f32(const char* name, pop::mirror::Arguments<float>* arguments) {
    return pop::mirror::call(name, arguments);
}

extern "C" int pop_mirror_f64(const char* name, pop::mirror::Arguments<double>* arguments) {
    return pop::mirror::call(name, arguments);
}
