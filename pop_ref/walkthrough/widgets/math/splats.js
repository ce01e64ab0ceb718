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
