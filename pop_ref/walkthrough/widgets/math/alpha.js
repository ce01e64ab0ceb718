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
