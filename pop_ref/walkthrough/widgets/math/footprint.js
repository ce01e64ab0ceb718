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
