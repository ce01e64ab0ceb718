// A port that the laws judge over its standard input and output: the kernels' mathematics on the host.
// The protocol stands in pop_ref/conformance/program_adapter.py. Words: "double" computes in that precision, "splats"
// goes back one splat a lane where it is otherwise a column of pixels a lane, and "exact" takes the kernels' own tiles
// of 16 x 8 px with exact lists.
#include <iostream>
#include <map>
#include <set>
#include <sstream>
#include <string>

#include "host_render.h"

using namespace pop::host;

template <class Real>
void serve(bool splats, bool exact) {
    using Array = std::vector<Real>;
    for (std::string line, verb; std::getline(std::cin, line);) {
        std::istringstream words(line);
        std::map<std::string, std::string> given;
        words >> verb;
        for (std::string word; words >> word;) given[word.substr(0, word.find('='))] = word.substr(word.find('=') + 1);
        if (verb == "hello") {
            std::cout << "ok name=host dtype=" << (sizeof(Real) == 8 ? "float64" : "float32")
                      << " profile=any offers=image,T_final,dominant_ids,dominant_weights,"
                         "n_blended,n_traversed,dominant_counts,v_means,v_quats,v_scales,v_opacities,v_sh,v_viewmat,"
                         "v_background,v_means2d,v_means2d_abs,antialiased,deterministic,rowwise,thousands" << std::endl;
            continue;
        }
        auto number = [&](const char* key) { return Real(std::stod(given[key])); };
        auto count = [&](const char* key) { return std::stoi(given[key]); };
        auto is = [&](const char* key, const char* value) { return given[key] == value; };
        const int n = count("N"), k = count("n_sh"), w = count("width"), h = count("height"), tile = count("tile_size");
        Arguments<Real> a = {};
        a.profile = {number("near_plane"), number("far_plane"), number("eps2d"), number("frustum_margin"),
                     number("extent_sigmas"), number("alpha_floor"), number("alpha_ceiling"),
                     number("transmittance_stop"), tile, is("near_inclusive", "1"), is("principal_point", "centred"),
                     is("clamp_gradient", "inria"), is("extent", "square"), is("ceiling_gradient", "pass"),
                     is("stop_inclusive", "1")};
        const int integers[] = {w, h, k, count("sh_degree"), exact ? 16 : tile, exact ? 8 : tile, count("antialiased"),
                                exact, splats};
        std::copy(std::begin(integers), std::end(integers), a.integers);
        a.n = n;
        std::vector<Array> in, out;
        for (int size : {3 * n, 4 * n, 3 * n, n, 3 * k * n, 16, 9, 3, 3 * h * w, h * w}) {
            std::vector<double> values(verb == "render" && in.size() >= 8 ? 0 : size);
            std::cin.read(reinterpret_cast<char*>(values.data()), std::streamsize(8 * values.size()));
            in.emplace_back(values.begin(), values.end());
        }
        const std::vector<int> sizes = verb == "render" ? std::vector<int>{3 * h * w, h * w, h * w, 2 * n, n, 3 * n, n}
                                                        : std::vector<int>{3 * n, 4 * n, 3 * n, n, 3 * k * n, 16, 3, 2 * n, 2 * n};
        for (int size : sizes) out.emplace_back(size);
        std::vector<std::vector<long long>> ids;
        for (int size : {h * w, h * w, h * w, n, 2 * n}) ids.emplace_back(size);
        for (size_t i = 0; i < in.size(); ++i) a.in[i] = in[i].data();
        for (size_t i = 0; i < out.size(); ++i) a.out[i] = out[i].data();
        for (size_t i = 0; i < ids.size(); ++i) a.ids[i] = ids[i].data();
        auto write = [](const auto& values) {
            for (double value : values) std::cout.write(reinterpret_cast<const char*>(&value), 8);
        };
        if (verb == "render") {
            render(a);
            std::cout << "ok image T_final dominant_weights dominant_ids n_blended n_traversed dominant_counts\n";
            for (int i = 0; i < 3; ++i) write(out[i]);
            for (int i = 0; i < 4; ++i) write(ids[i]);
        } else {
            render_vjp(a);
            std::cout << "ok v_means v_quats v_scales v_opacities v_sh v_viewmat v_background v_means2d v_means2d_abs\n";
            for (const Array& each : out) write(each);
        }
        std::cout.flush();
    }
}

int main(int argc, char** argv) {
    std::ios::sync_with_stdio(false);
    const std::set<std::string> words(argv + 1, argv + argc);
    const bool splats = words.count("splats") > 0, exact = words.count("exact") > 0;
    words.count("double") ? serve<double>(splats, exact) : serve<float>(splats, exact);
}
