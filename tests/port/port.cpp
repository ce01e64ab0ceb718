// A port that the laws judge over its standard input and output: the kernels' mathematics on the host, in float.
// The protocol stands in pop_ref/conformance/program_adapter.py.
#include <iostream>
#include <map>
#include <sstream>
#include <string>

#include "mirror_render.h"

using namespace pop::mirror;
using Array = std::vector<float>;

int main() {
    std::ios::sync_with_stdio(false);
    for (std::string line, verb; std::getline(std::cin, line);) {
        std::istringstream words(line);
        std::map<std::string, std::string> given;
        words >> verb;
        for (std::string word; words >> word;) given[word.substr(0, word.find('='))] = word.substr(word.find('=') + 1);
        if (verb == "hello") {
            std::cout << "ok name=host dtype=float32 profile=any offers=image,T_final,dominant_ids,dominant_weights,"
                         "n_blended,n_traversed,dominant_counts,v_means,v_quats,v_scales,v_opacities,v_sh,v_viewmat,"
                         "v_background,v_means2d,v_means2d_abs,antialiased,deterministic,rowwise,thousands" << std::endl;
            continue;
        }
        auto number = [&](const char* key) { return float(std::stod(given[key])); };
        auto count = [&](const char* key) { return std::stoi(given[key]); };
        auto is = [&](const char* key, const char* value) { return given[key] == value; };
        const int n = count("N"), k = count("n_sh"), w = count("width"), h = count("height"), tile = count("tile_size");
        Arguments<float> a = {};
        a.profile = {number("near_plane"), number("far_plane"), number("eps2d"), number("frustum_margin"),
                     number("extent_sigmas"), number("alpha_floor"), number("alpha_ceiling"),
                     number("transmittance_stop"), tile, is("near_inclusive", "1"), is("principal_point", "centred"),
                     is("clamp_gradient", "inria"), is("extent", "square"), is("ceiling_gradient", "pass"),
                     is("stop_inclusive", "1")};
        const int integers[] = {w, h, k, count("sh_degree"), tile, tile, count("antialiased")};
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
