// GLSL: the deforming mesh with the image on it, the needle's echo, and what can be laid over it.

export const VERTEX = `#version 300 es
precision highp float;
in vec2 rest;       // mm
in vec2 moved;      // displacement of this node, mm
in vec2 other;      // the compared model's
uniform vec4 toClip;             // scale x y, offset x y: mm to clip coordinates
uniform int landmarkCount;       // -1: take \`moved\`
uniform highp sampler2D landmarks;  // (x, y, weight x, weight y), conditioned
uniform vec4 kernel;             // components, coupling, radius, scale
uniform vec2 centre;
uniform vec2 motion[3];
uniform bool difference;
out vec2 vRest;
out vec2 vWorld;
out vec2 vField;

vec2 splineAt(vec2 point) {
  vec2 x = (point - centre) / kernel.w;
  vec2 u = kernel.x < 1.5
    ? motion[0] + motion[1] * x.x + motion[2] * x.y
    : vec2(motion[0].x - motion[1].x * x.y, motion[0].y + motion[1].x * x.x);
  for (int k = 0; k < landmarkCount; ++k) {
    vec4 l = texelFetch(landmarks, ivec2(k & 255, k >> 8), 0);
    vec2 d = x - l.xy;
    float r2 = dot(d, d);
    if (kernel.x < 1.5) {
      u += (r2 > 0.0 ? r2 * log(r2) : 0.0) * l.zw;
    } else {
      float s = r2 + kernel.z * kernel.z;
      float same = -(4.0 - 2.0 * kernel.y) * (log(s) + 1.0) - 4.0 * r2 / s;
      u += same * l.zw + 4.0 * kernel.y * dot(d, l.zw) / s * d;
    }
  }
  return u;
}

void main() {
  vec2 u = landmarkCount >= 0 ? splineAt(rest) : moved;
  vRest = rest;
  vWorld = rest + u;
  vField = difference ? u - other : u;
  gl_Position = vec4(vWorld * toClip.xy + toClip.zw, 0.0, 1.0);
}`;

// The needle is simpler than the one that the core draws; its numbers are PAGE_LOOK in served_scene.py.
export const FRAGMENT = `#version 300 es
precision highp float;
in vec2 vRest;
in vec2 vWorld;
in vec2 vField;
uniform sampler2D image;
uniform vec4 pixels;      // origin x y, spacing x y, mm
uniform vec4 mesh;        // origin x y, distance of the drawn lines x y, mm
uniform vec3 tone;        // gain, contrast, 1 to invert
uniform vec4 shaftEnds;   // entry, tip, mm
uniform vec4 look;        // radius, width (mm), fade angle (degrees), floor
uniform vec3 strength;    // brightness, opacity, refill (mm)
uniform vec3 apex;        // x, y, 1 for a curved array
uniform ivec4 traits;     // shaft, tip, reverberation, shadow
uniform vec4 heat;        // 1 to show it, full scale in mm, opacity, 1 to draw the mesh
uniform sampler2D colours;
out vec4 colour;

float ends(float s, float len) {
  float beyond = max(max(-s, s - len), 0.0) / look.y;
  return exp(-beyond * beyond);
}
float wall(float d) { float q = d / look.y; return exp(-q * q); }
float rise(float x) { float t = clamp(0.5 * (x + 1.0), 0.0, 1.0); return t * t * (3.0 - 2.0 * t); }

vec2 needle(vec2 p) {   // (brightness, transmission)
  vec2 along = shaftEnds.zw - shaftEnds.xy;
  float len = length(along);
  if (len < 1e-4) return vec2(0.0, 1.0);
  vec2 axis = along / len;
  float radius = look.x, width = look.y;
  float arrival = min(1.0, len / (2.0 * radius));
  vec2 beam = apex.z > 0.5 ? normalize(p - apex.xy) : vec2(0.0, 1.0);
  vec2 across = vec2(-axis.y, axis.x);
  float side = dot(beam, across) < 0.0 ? -1.0 : 1.0;
  float facing = side * dot(beam, across);
  float drop = dot(beam, axis);
  float s = dot(p - shaftEnds.xy, axis);
  float d = side * dot(p - shaftEnds.xy, across);
  float tilt = degrees(acos(min(facing, 1.0)));
  float mirror = exp(-(tilt / look.z) * (tilt / look.z));
  float echo = look.w + (1.0 - look.w) * mirror;
  float light = 0.0;
  float spacing = max(2.0 * radius, 3.0 * width), reach = 3.0 * (width + radius);
  float deepest = reach + (traits.z != 0 ? 6.0 * spacing : 0.0);
  bool near = d > -reach && d < deepest && s > -deepest && s < len + deepest;
  if (near && traits.x != 0) {
    float u = len - s;
    float grain = 0.88 + 0.12 * sin(2.1 * u) * sin(0.73 * u + 1.0);
    float between = d / (radius + width);
    float line = min(wall(d + radius) + 0.6 * wall(d - radius) + 0.45 * exp(-between * between), 1.0);
    light += echo * grain * line * ends(s, len);
  }
  if (near && traits.z != 0) {
    float loss = 0.8;
    for (int k = 1; k <= 5; ++k) {
      loss *= 0.65;
      float shift = float(k + 1) * spacing;
      light += loss * echo * mirror * wall(d + radius - shift * facing) * ends(s - shift * drop, len);
    }
  }
  if (near && traits.y != 0) {
    float w = width + 0.7 * radius;
    light = max(light, (0.85 + 0.15 * mirror) * exp(-dot(p - shaftEnds.zw, p - shaftEnds.zw) / (w * w)));
  }
  float passed = 1.0;
  if (traits.w != 0) {
    float behind = max(d, 0.0) / max(facing, 1e-6);
    float met = s - behind * drop;
    float edge = width + 0.04 * behind;
    float inside = rise(met / edge) * rise((len - met) / edge);
    float onset = clamp(d / (2.0 * radius), 0.0, 1.0) * exp(-behind / strength.z);
    passed = 1.0 - arrival * strength.y * facing * onset * inside;
  }
  return vec2(arrival * strength.x * min(light, 1.0), passed);
}

float linesAt(vec2 rest) {
  vec2 g = (rest - mesh.xy) / mesh.zw;
  vec2 d = abs(fract(g - 0.5) - 0.5) / max(fwidth(g), 1e-6);
  return 1.0 - clamp(min(d.x, d.y) - 0.4, 0.0, 1.0);
}

void main() {
  vec2 size = vec2(textureSize(image, 0));
  float grey = texture(image, ((vRest - pixels.xy) / pixels.zw + 0.5) / size).r;
  vec2 n = needle(vWorld);
  grey *= n.y;
  grey += n.x * (1.0 - grey);
  grey = clamp((grey - 0.5) * tone.y + 0.5 + tone.x, 0.0, 1.0);
  vec3 shown = vec3(tone.z > 0.5 ? 1.0 - grey : grey);
  if (heat.x > 0.5) {
    float share = clamp(length(vField) / heat.y, 0.0, 1.0);
    float cover = heat.z * smoothstep(0.0, 0.12, share) * (1.0 - min(1.4 * n.x, 1.0));  // the needle stays visible
    shown = mix(shown, texture(colours, vec2(share, 0.5)).rgb, cover);
  }
  if (heat.w > 0.5) shown = mix(shown, vec3(0.35, 0.85, 0.95), 0.45 * linesAt(vRest));
  colour = vec4(shown, 1.0);
}`;
