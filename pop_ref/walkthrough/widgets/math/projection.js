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
