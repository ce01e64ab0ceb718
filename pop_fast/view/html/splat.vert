#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

// a Gaussian is three texels: (mean, opacity), (xx, xy, xz, yy), (yz, zz, -, -) of its covariance
uniform sampler2D geometry;
// its colours' bytes, of degree 0 and then of the others, four a texel
uniform usampler2D colors;
uniform int coefficients;
uniform mat4 viewmat;
uniform vec3 eye;
uniform vec2 focal;
uniform vec2 centre;
uniform vec2 size;
// near plane, low-pass, frustum margin, extent in standard deviations
uniform vec4 constants;
uniform float floorAlpha;
uniform bool antialiased;

layout(location = 0) in uint row;

out vec3 color;
out vec2 offset;
flat out float opacity;

const vec2 CORNERS[4] = vec2[4](vec2(-1, -1), vec2(1, -1), vec2(-1, 1), vec2(1, 1));

vec4 geometryTexel(int at) {
  int width = textureSize(geometry, 0).x;
  return texelFetch(geometry, ivec2(at % width, at / width), 0);
}

float colorByte(int index) {
  int perRow = textureSize(colors, 0).x / ((coefficients * 3 + 6) / 4);
  int at = (int(row) % perRow) * ((coefficients * 3 + 6) / 4) + index / 4;
  return float(texelFetch(colors, ivec2(at, int(row) / perRow), 0)[index % 4]);
}

vec3 coefficient(int k) {
  return (vec3(colorByte(3 * k), colorByte(3 * k + 1), colorByte(3 * k + 2)) - 128.0) / 128.0;
}

vec3 seenAlong(vec3 d) {
  vec3 base = (vec3(colorByte(0), colorByte(1), colorByte(2)) - 127.5) / 38.25;
  vec3 c = 0.5 + 0.28209479177387814 * base;
  float x = d.x, y = d.y, z = d.z;
  if (coefficients >= 3) {
    c += 0.4886025119029199 * (-y * coefficient(1) + z * coefficient(2) - x * coefficient(3));
  }
  if (coefficients >= 8) {
    c += 1.0925484305920792 * (x * y * coefficient(4) - y * z * coefficient(5) - x * z * coefficient(7));
    c += 0.31539156525252005 * (2.0 * z * z - x * x - y * y) * coefficient(6);
    c += 0.5462742152960396 * (x * x - y * y) * coefficient(8);
  }
  if (coefficients >= 15) {
    c -= 0.5900435899266435 * (y * (3.0 * x * x - y * y) * coefficient(9) + x * (x * x - 3.0 * y * y) * coefficient(15));
    c += 2.890611442640554 * x * y * z * coefficient(10);
    c -= 0.4570457994644658 * (4.0 * z * z - x * x - y * y) * (y * coefficient(11) + x * coefficient(13));
    c += 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y) * coefficient(12);
    c += 1.445305721320277 * z * (x * x - y * y) * coefficient(14);
  }
  return max(c, 0.0);
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  color = vec3(0.0);
  offset = vec2(0.0);
  opacity = 0.0;
  vec4 first = geometryTexel(3 * int(row));
  vec4 second = geometryTexel(3 * int(row) + 1);
  vec4 third = geometryTexel(3 * int(row) + 2);
  vec3 p = (viewmat * vec4(first.xyz, 1.0)).xyz;
  if (p.z < constants.x) return;

  // the projection's derivative, taken no further outside the image than the margin
  vec2 margin = constants.z * 0.5 * size / focal;
  vec2 t = clamp(p.xy / p.z, -centre / focal - margin, (size - centre) / focal + margin) * p.z;
  mat3 J = mat3(
    focal.x / p.z, 0.0, 0.0,
    0.0, focal.y / p.z, 0.0,
    -focal.x * t.x / (p.z * p.z), -focal.y * t.y / (p.z * p.z), 0.0);
  mat3 covariance = mat3(
    second.x, second.y, second.z,
    second.y, second.w, third.x,
    second.z, third.x, third.y);
  mat3 M = J * mat3(viewmat);
  mat3 screen = M * covariance * transpose(M);
  float a = screen[0][0] + constants.y, b = screen[0][1], c = screen[1][1] + constants.y;

  opacity = first.w;
  if (antialiased) {
    float before = screen[0][0] * screen[1][1] - b * b;
    opacity *= sqrt(max(before / (a * c - b * b), 0.0));
  }
  if (opacity < floorAlpha) return;
  float radius = min(constants.w, sqrt(2.0 * log(opacity / floorAlpha)));

  float middle = 0.5 * (a + c), half_ = 0.5 * (a - c);
  float spread = sqrt(half_ * half_ + b * b);
  float larger = middle + spread, smaller = max(middle - spread, 1e-6);
  vec2 axis = spread < 1e-9 * middle ? vec2(1.0, 0.0)
    : half_ > 0.0 ? normalize(vec2(spread + half_, b)) : normalize(vec2(b, spread - half_));

  offset = CORNERS[gl_VertexID] * radius;
  vec2 pixel = focal * p.xy / p.z + centre
    + offset.x * sqrt(larger) * axis + offset.y * sqrt(smaller) * vec2(-axis.y, axis.x);
  color = seenAlong(normalize(first.xyz - eye));
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}
