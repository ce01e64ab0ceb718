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
