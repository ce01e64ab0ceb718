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
