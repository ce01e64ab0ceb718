#version 300 es
precision highp float;

uniform float floorAlpha;
uniform float ceilingAlpha;

in vec3 color;
in vec2 offset;
flat in float opacity;

out vec4 result;

void main() {
  float alpha = min(ceilingAlpha, opacity * exp(-0.5 * dot(offset, offset)));
  if (alpha < floorAlpha) discard;
  result = vec4(color * alpha, alpha);
}
