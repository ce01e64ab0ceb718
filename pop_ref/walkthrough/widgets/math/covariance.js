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
