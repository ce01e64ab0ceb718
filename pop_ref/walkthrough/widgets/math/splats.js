// A Gaussian on its way from the world to a pixel: pure functions, of one Gaussian and one pixel at a time.

// Covariances from rotations and standard deviations, as pop_ref/covariance.py has them, one Gaussian at a time.

function matmul(A, B) {
  return A.map((row) => B[0].map((_, j) => row.reduce((sum, a, k) => sum + a * B[k][j], 0)));
}

function transpose(A) {
  return A[0].map((_, j) => A.map((row) => row[j]));
}

function rotmats_from_quats(quat) {
  const norm = Math.hypot(...quat);
  const [w, x, y, z] = quat.map((q) => q / norm);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

function covars_from_quats_scales(quat, scales) {
  const M = rotmats_from_quats(quat).map((row) => row.map((r, j) => r * scales[j]));
  return matmul(M, transpose(M));
}

// World to camera to screen, as pop_ref/camera.py and projection.py have them, one Gaussian at a time.

function means_cam_from_means(mean, viewmat) {
  return [0, 1, 2].map((i) => viewmat[i][0] * mean[0] + viewmat[i][1] * mean[1] + viewmat[i][2] * mean[2] + viewmat[i][3]);
}

function covars_cam_from_covars(covar, viewmat) {
  const R = [0, 1, 2].map((i) => viewmat[i].slice(0, 3));
  return matmul(matmul(R, covar), transpose(R));
}

function project_means(mean_cam, K) {
  const [x, y, z] = mean_cam;
  return [(K[0][0] * x) / z + K[0][2], (K[1][1] * y) / z + K[1][2]];
}

// x/z and y/z are clamped to a little more than the image
function projection_jacobians(mean_cam, K, width, height) {
  const [x, y, z] = mean_cam;
  const offset = (slope, f, c, size) => {
    const margin = (PAPER.frustum_margin * 0.5 * size) / f;
    return z * Math.min(Math.max(slope, -(c / f + margin)), (size - c) / f + margin);
  };
  const tx = offset(x / z, K[0][0], K[0][2], width);
  const ty = offset(y / z, K[1][1], K[1][2], height);
  return [
    [K[0][0] / z, 0, (-K[0][0] * tx) / (z * z)],
    [0, K[1][1] / z, (-K[1][1] * ty) / (z * z)],
  ];
}

function project_covars(covar_cam, jacobian) {
  return matmul(matmul(jacobian, covar_cam), transpose(jacobian));
}

// Spherical harmonics to colour, as pop_ref/harmonics.py has them, one direction at a time.

const SH_C0 = Math.sqrt(1 / (4 * Math.PI));
const SH_C1 = Math.sqrt(3 / (4 * Math.PI));
const SH_C2 = Math.sqrt(15 / (4 * Math.PI));
const SH_C2_Z = Math.sqrt(5 / (16 * Math.PI));
const SH_C3_3 = Math.sqrt(35 / (32 * Math.PI));
const SH_C3_2 = Math.sqrt(105 / (4 * Math.PI));
const SH_C3_1 = Math.sqrt(21 / (32 * Math.PI));
const SH_C3_0 = Math.sqrt(7 / (16 * Math.PI));

function sh_basis(dir, degree) {
  const [x, y, z] = dir;
  const [xx, yy, zz] = [x * x, y * y, z * z];
  return [
    SH_C0,
    -SH_C1 * y,
    SH_C1 * z,
    -SH_C1 * x,
    SH_C2 * x * y,
    -SH_C2 * y * z,
    SH_C2_Z * (2 * zz - xx - yy),
    -SH_C2 * x * z,
    (SH_C2 / 2) * (xx - yy),
    -SH_C3_3 * y * (3 * xx - yy),
    SH_C3_2 * x * y * z,
    -SH_C3_1 * y * (4 * zz - xx - yy),
    SH_C3_0 * z * (2 * zz - 3 * xx - 3 * yy),
    -SH_C3_1 * x * (4 * zz - xx - yy),
    (SH_C3_2 / 2) * z * (xx - yy),
    -SH_C3_3 * x * (xx - 3 * yy),
  ].slice(0, (degree + 1) ** 2);
}

// sh holds [r, g, b] per coefficient; the direction runs from the camera to the Gaussian, of any length
function colors_from_sh(sh, dir, degree) {
  const norm = Math.hypot(...dir);
  const basis = sh_basis(dir.map((d) => d / norm), degree);
  return [0, 1, 2].map((c) => Math.max(basis.reduce((sum, Y, k) => sum + Y * sh[k][c], 0) + 0.5, 0));
}

// One splat at one pixel, as pop_ref/alpha.py has it: exponent, falloff, alpha, and their transposes.

function sigma_at_pixel(mean2d, conic, px, py) {
  const [A, B, C] = conic;
  const dx = mean2d[0] - px;
  const dy = mean2d[1] - py;
  return 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy;
}

function sigma_at_pixel_vjp(mean2d, conic, px, py, v_sigma) {
  const [A, B, C] = conic;
  const dx = mean2d[0] - px;
  const dy = mean2d[1] - py;
  const v_mean2d = [v_sigma * (A * dx + B * dy), v_sigma * (B * dx + C * dy)];
  const v_conic = [v_sigma * 0.5 * dx * dx, v_sigma * dx * dy, v_sigma * 0.5 * dy * dy];
  return [v_mean2d, v_conic];
}

function falloff(sigma) {
  return Math.exp(-sigma);
}

function falloff_vjp(sigma, v_falloff) {
  return -Math.exp(-sigma) * v_falloff;
}

// alpha, and whether the splat is skipped at this pixel
function alpha_from_sigma(sigma, opacity) {
  if (sigma < 0) return [0, true];
  const alpha = Math.min(PAPER.alpha_ceiling, opacity * falloff(sigma));
  return [alpha, alpha < PAPER.alpha_floor];
}

function alpha_from_sigma_vjp(sigma, opacity, v_alpha) {
  const skipped = alpha_from_sigma(sigma, opacity)[1];
  if (skipped || opacity * falloff(sigma) > PAPER.alpha_ceiling) return [0, 0];
  return [falloff_vjp(sigma, opacity * v_alpha), falloff(sigma) * v_alpha];
}

// The splat on the screen, as pop_ref/footprint.py has it, one splat at a time: a covariance is [[a, b], [b, c]], px².

function low_pass(covar2d, eps2d) {
  const [[a, b], [b_too, c]] = covar2d;
  return [[a + eps2d, b], [b_too, c + eps2d]];
}

function det2(covar2d) {
  const [[a, b], [b_too, c]] = covar2d;
  return a * c - b * b_too;
}

function compensations(covar2d, eps2d) {
  const det = det2(covar2d);
  const det_blurred = det2(low_pass(covar2d, eps2d));
  return det > 0 && det_blurred > 0 ? Math.sqrt(det / det_blurred) : 0;
}

// (xx, xy, yy) of the inverse; zero where there is none
function conics_from_covars2d(covar2d) {
  const [[a, b], [b_too, c]] = covar2d;
  const det = det2(covar2d);
  return det > 0 ? [c / det, (-0.5 * (b + b_too)) / det, a / det] : [0, 0, 0];
}

// how many standard deviations from the centre alpha falls to the floor; 0 where it never reaches it
function reach_in_sigmas(opacity) {
  if (opacity < PAPER.alpha_floor) return 0;
  return Math.min(PAPER.extent_sigmas, Math.sqrt(2 * Math.log(opacity / PAPER.alpha_floor)));
}

function radii_from_covars2d(covar2d, opacity) {
  if (det2(covar2d) <= 0) return [0, 0];
  const k = reach_in_sigmas(opacity);
  return [Math.ceil(k * Math.sqrt(covar2d[0][0])), Math.ceil(k * Math.sqrt(covar2d[1][1]))];
}

// One pixel, as pop_ref/pixel.py and dominance.py have it: front-to-back blending, its end, and the way back.

function stops(next_T) {
  return next_T <= PAPER.transmittance_stop;
}

function composite_pixel(ids, rows, px, py, background) {
  const color = background.map(() => 0);
  const pixel = { color, T_final: 1, ids: [], alphas: [], transmittances: [], weights: [], n_traversed: 0 };
  for (const i of ids) {
    pixel.n_traversed += 1;
    const sigma = sigma_at_pixel(rows.means2d[i], rows.conics[i], px, py);
    const [alpha, skipped] = alpha_from_sigma(sigma, rows.opacities[i]);
    if (skipped) continue;
    const next_T = pixel.T_final * (1 - alpha);
    if (stops(next_T)) break;
    const weight = pixel.T_final * alpha;
    rows.colors[i].forEach((c, k) => { color[k] += weight * c; });
    pixel.ids.push(i);
    pixel.alphas.push(alpha);
    pixel.transmittances.push(pixel.T_final);
    pixel.weights.push(weight);
    pixel.T_final = next_T;
  }
  background.forEach((b, k) => { color[k] += pixel.T_final * b; });
  return pixel;
}

// cotangents of alphas (by splat), opacities, colours and the background, from the back of the pixel to its front
function composite_pixel_vjp(pixel, rows, px, py, background, v_color, v_T_final) {
  const zeros = () => rows.opacities.map(() => 0);
  const v = { v_alphas: zeros(), v_opacities: zeros(), v_colors: rows.colors.map((c) => c.map(() => 0)) };
  v.v_background = v_color.map((g) => pixel.T_final * g);
  let behind = v_T_final;
  background.forEach((b, k) => { behind += b * v_color[k]; });
  for (let at = pixel.ids.length - 1; at >= 0; at -= 1) {
    const [i, alpha, T] = [pixel.ids[at], pixel.alphas[at], pixel.transmittances[at]];
    let worth = 0;
    rows.colors[i].forEach((c, k) => {
      worth += c * v_color[k];
      v.v_colors[i][k] += T * alpha * v_color[k];
    });
    v.v_alphas[i] = T * (worth - behind);
    behind += alpha * (worth - behind);
    const sigma = sigma_at_pixel(rows.means2d[i], rows.conics[i], px, py);
    v.v_opacities[i] += alpha_from_sigma_vjp(sigma, rows.opacities[i], v.v_alphas[i])[1];
  }
  return v;
}

function dominant_id(ids, weights) {
  let [best_id, best_weight] = [-1, 0];
  ids.forEach((i, at) => {
    if (weights[at] > best_weight) [best_id, best_weight] = [i, weights[at]];
  });
  return best_id;
}
