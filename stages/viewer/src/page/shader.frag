#version 300 es
// Marches one ray per pixel through the volume and composites opacity, colour and view components of
// each step. View dependence is then added to the colour, once per ray (deferred shading, as in the
// field itself).
precision highp float;
precision highp int;
precision highp sampler3D;
precision highp usampler3D;

// The volume. A texel of `bricks` has the brick's position in the atlas (rgb) and the distance to the
// nearest brick in bricks (a), 0 in a brick. A brick has 8³ voxels and its upper neighbours' first ones.
uniform usampler3D bricks;
uniform sampler3D colours;  // rgb: colour times opacity; a: opacity of a step of a voxel's length
uniform sampler3D views;    // components of the view dependence times opacity
uniform vec3 atlas_size;    // of both textures, in texels
uniform float resolution;   // voxels along the cube's side
uniform vec3 components[36];  // four times nine spherical harmonics' red, green and blue

// The box in the unit cube. All lengths are relative to its longest side: single precision is too
// coarse for world coordinates far from the origin, which only the page's script uses.
uniform vec3 extent;
uniform vec2 range;  // distances between which there is anything

// The camera: OpenGL's axes; pixels from the upper left corner.
uniform mat3 rotation;
uniform vec3 centre;  // in the unit cube
uniform vec4 intrinsics;  // fx, fy, cx, cy
uniform float height;

const int COLOUR = 0, DEPTH = 1, OPACITY = 2, READS = 3;
uniform int mode;
uniform vec3 background;
uniform vec2 depth_range;

out vec4 shown;

const float FAR = 1e30;
// Length of a step in voxels. Shorter steps render nearly the same with more reads (docs/design/042).
const float STEP = 1.0;
// Transmittance below which a ray ends (docs/design/042).
const float DARK = 1.0 / 256.0;
const int MAX_STEPS = 4096;

int reads = 0;

// Ray in the cube; its parameter t is the distance over the box's longest side.
struct CubeRay {
  vec3 origin, direction;
  float enter, leave;
};

// Limits [enter, leave] to the interval with offset + slope * x >= 0.
void clip_to(float offset, float slope, inout vec2 part) {
  if (slope > 0.0) part.x = max(part.x, -offset / slope);
  else if (slope < 0.0) part.y = min(part.y, -offset / slope);
  else if (offset < 0.0) part = vec2(1.0, 0.0);
}

CubeRay clipped(vec3 origin, vec3 along) {
  vec2 part = range;
  for (int i = 0; i < 3; i++) {
    clip_to(origin[i], along[i], part);
    clip_to(extent[i] - origin[i], -along[i], part);
  }
  return CubeRay(origin, along, part.x, part.y);
}

vec3 place_at(CubeRay ray, float t) { return ray.origin + t * ray.direction; }

// Returns the minimum increase of t after which a ray leaves the surrounding empty bricks, whose
// corners in voxels are `low` and `high`.
float way_out(CubeRay ray, vec3 at, vec3 low, vec3 high) {
  vec3 speed = ray.direction * resolution;
  vec3 wall = mix(low, high, step(0.0, speed));
  vec3 way = mix((wall - at) / speed, vec3(FAR), lessThan(abs(speed), vec3(1e-6)));
  return min(min(way.x, way.y), way.z);
}

// Returns the view dependence of the colour's logit for composited components and a direction.
vec3 view_part(vec4 weights, vec3 d) {
  float basis[9] = float[9](
    0.2820948, -0.4886025 * d.y, 0.4886025 * d.z, -0.4886025 * d.x, 1.0925484 * d.x * d.y,
    -1.0925484 * d.y * d.z, 0.31539157 * (3.0 * d.z * d.z - 1.0), -1.0925484 * d.x * d.z,
    0.5462742 * (d.x * d.x - d.y * d.y));
  vec3 sum = vec3(0);
  for (int i = 0; i < 9; i++) {
    sum += basis[i] * (weights.x * components[i] + weights.y * components[9 + i]
      + weights.z * components[18 + i] + weights.w * components[27 + i]);
  }
  return sum;
}

struct Seen {
  vec3 colour;    // times opacity
  vec4 view;      // times opacity
  float through;  // light that nothing stops
  float median;   // t at which half of it is stopped; negative where that never is
};

Seen march(CubeRay ray) {
  Seen seen = Seen(vec3(0), vec4(0), 1.0, -FAR);
  float h = STEP / resolution;
  ivec3 last = ivec3(resolution) / 8 - 1, current = ivec3(-1);
  uvec4 brick;
  float t = ray.enter + 0.5 * h;
  for (int i = 0; i < MAX_STEPS && t < ray.leave && seen.through > DARK; i++) {
    vec3 at = clamp(place_at(ray, t) * resolution - 0.5, 0.0, resolution - 1.0);
    ivec3 own = min(ivec3(at) / 8, last);
    if (own != current) {
      brick = texelFetch(bricks, own, 0);
      reads++;
      current = own;
    }
    if (brick.a > 0u) {
      float far = float(brick.a);
      vec3 low = 8.0 * (vec3(own) - far + 1.0), high = 8.0 * (vec3(own) + far);
      t += h * max(ceil(way_out(ray, at, low, high) / h), 1.0);
      continue;
    }
    vec3 texel = (9.0 * vec3(brick.rgb) + at - 8.0 * vec3(own) + 0.5) / atlas_size;
    vec4 colour = texture(colours, texel);
    reads++;
    if (colour.a > 0.0) {
      float kept = STEP == 1.0 ? 1.0 - colour.a : pow(1.0 - colour.a, STEP);
      float weight = seen.through * (1.0 - kept) / colour.a;
      seen.colour += weight * colour.rgb;
      seen.view += weight * (255.0 * texture(views, texel) - 128.0) / 127.0;
      reads++;
      float through = seen.through * max(kept, 1e-6);
      if (seen.through > 0.5 && through <= 0.5) {
        // Light decreases evenly within the step.
        seen.median = t + h * (log(2.0 * seen.through) / log(seen.through / through) - 0.5);
      }
      seen.through = through;
    }
    t += h;
  }
  return seen;
}

// Returns the colour of a depth, from near (warm) to far.
vec3 of_depth(float share) {
  const vec3 stops[5] = vec3[5](
    vec3(0.75, 0.15, 0.10), vec3(0.95, 0.60, 0.20), vec3(0.90, 0.90, 0.55), vec3(0.25, 0.65, 0.70),
    vec3(0.15, 0.20, 0.50));
  float at = 4.0 * clamp(share, 0.0, 1.0);
  int k = min(int(at), 3);
  return mix(stops[k], stops[k + 1], at - float(k));
}

vec3 logit(vec3 c) { c = clamp(c, 1.0 / 512.0, 511.0 / 512.0); return log(c / (1.0 - c)); }

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, height - gl_FragCoord.y);
  vec2 slope = (pixel - intrinsics.zw) / intrinsics.xy;
  vec3 own = normalize(vec3(slope.x, -slope.y, -1.0));
  vec3 along = rotation * own;
  CubeRay ray = clipped(centre, along);
  Seen seen = march(ray);
  float opacity = 1.0 - seen.through;
  if (mode == READS) {
    shown = vec4(float(reads % 256) / 255.0, float(reads / 256) / 255.0, 0.0, 1.0);
  } else if (mode == OPACITY) {
    shown = vec4(vec3(opacity), 1.0);
  } else if (mode == DEPTH) {
    float z = -own.z * seen.median;
    // Colours are uniform in disparity, so that near depths have most of them.
    vec2 ends = 1.0 / depth_range;
    vec3 colour = of_depth((1.0 / z - ends.x) / (ends.y - ends.x));
    shown = vec4(seen.median > -FAR ? mix(vec3(1), colour, opacity) : vec3(1), 1.0);
  } else {
    vec3 colour = vec3(0);
    if (opacity > 1.0 / 512.0) {
      vec3 raw = logit(seen.colour / opacity) + view_part(seen.view / opacity, along);
      colour = opacity / (1.0 + exp(-raw));
    }
    shown = vec4(colour + seen.through * background, 1.0);
  }
}
