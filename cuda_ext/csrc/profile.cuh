// The table of constants that defines a render; the counterpart of pop_ref/constants.py, whose names it keeps.
#pragma once

#include "real.cuh"

namespace pop {

template <class Real>
struct Profile {
    Real near_plane;          // D1
    Real far_plane;           // D1
    Real eps2d;               // px^2
    Real frustum_margin;      // B1
    Real extent_sigmas;       // D2
    Real alpha_floor;         // D5
    Real alpha_ceiling;       // D6
    Real transmittance_stop;  // D7
    int tile_size;            // D3
    bool near_inclusive;      // D1
    bool centred;             // principal point at the image's centre
    bool inria_clamp;         // B1: the clamp's z term is left out
    bool square;              // D2, D3: Inria's extent
    bool pass_ceiling;        // B3: a clamped alpha passes its gradient
    bool stop_inclusive;      // D7
};

// rigid world -> camera and pinhole, as the oracle's Camera
template <class Real>
struct Camera {
    Mat3<Real> R;
    Vec3<Real> t;
    Real fx, fy, cx, cy;
    int width, height;
};

// K and viewmat are row-major 3x3 and 4x4; the profile decides whose principal point counts
template <class Real>
POP_HD Camera<Real> camera_from_matrices(const Real* viewmat, const Real* K, int width, int height, bool centred) {
    Camera<Real> camera;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) camera.R.m[i][j] = viewmat[4 * i + j];
    camera.t = {viewmat[3], viewmat[7], viewmat[11]};
    camera.fx = K[0];
    camera.fy = K[4];
    camera.cx = centred ? Real(width) / Real(2) : K[2];
    camera.cy = centred ? Real(height) / Real(2) : K[5];
    camera.width = width;
    camera.height = height;
    return camera;
}

}  // namespace pop
