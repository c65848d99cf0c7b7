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

// The field's space. Single precision is too coarse for world coordinates far from the origin, which only
// the page's script uses. Lengths here are relative to the space's unit: the box's longest side, the depth of
// the frustum's near plane, or the radius of the ball that a contraction leaves unchanged.
const int BOX = 0, NDC = 1, CONTRACTION = 2;
uniform int space;
uniform vec3 extent;    // box: upper corner in the unit cube
uniform vec2 range;     // distances between which there is anything
uniform mat3 turn;      // NDC: world directions to the frustum's: x to the right, y up, and depth
uniform vec4 slopes;    // NDC: minimum and maximum of x/z and y/z
uniform float far;      // NDC: depth of the far plane

// The camera: OpenGL's axes; pixels from the upper left corner.
uniform mat3 rotation;
uniform vec3 centre;  // from the box's lower corner, from the frustum's centre (turned), or from the ball's
uniform vec4 intrinsics;  // fx, fy, cx, cy
uniform float height;

const int COLOUR = 0, DEPTH = 1, OPACITY = 2, READS = 3, PROBE = 4;
uniform int mode;
uniform vec3 background;
uniform vec2 depth_range;

out vec4 shown;

const float FAR = 1e30;
// Transmittance below which a ray ends (docs/design/042).
const float DARK = 1.0 / 256.0;
const int MAX_STEPS = 4096;
// Share of a ray's light for which view dependence is read once (docs/design/042).
const float VIEW_SHARE = 1.0 / 16.0;

int reads = 0;

// Ray in the unit cube with a parameter t, as in the field: in a box and in NDC the distance along the ray in
// cube sides. In a contraction the position at t is contracted from the point radii * sinh(4 t) beyond `origin`,
// the ray's point nearest to the centre. `map` gives the distance.
struct CubeRay {
  vec3 origin, direction;
  float enter, leave, radii;
  vec3 map;
};

const CubeRay MISS = CubeRay(vec3(0), vec3(0), 0.0, 0.0, 0.0, vec3(0));

// Limits [x, y] to the interval with offset + slope * x >= 0.
void clip_to(float offset, float slope, inout vec2 part) {
  if (slope > 0.0) part.x = max(part.x, -offset / slope);
  else if (slope < 0.0) part.y = min(part.y, -offset / slope);
  else if (offset < 0.0) part = vec2(1.0, 0.0);
}

CubeRay ray_in_box(vec3 along) {
  vec2 part = range;
  for (int i = 0; i < 3; i++) {
    clip_to(centre[i], along[i], part);
    clip_to(extent[i] - centre[i], -along[i], part);
  }
  return CubeRay(centre, along, part.x, part.y, 0.0, vec3(0.0, 1.0, 0.0));
}

// Converts a point of the frustum's camera to the unit cube.
vec3 to_cube(vec3 p) {
  float side = max(slopes.z - slopes.x, slopes.w - slopes.y);
  return vec3((p.xy / p.z - slopes.xy) / side, (1.0 - 1.0 / p.z) / (1.0 - 1.0 / far));
}

CubeRay ray_in_frustum(vec3 along) {
  vec3 d = turn * along;
  vec2 part = range;
  clip_to(centre.z - 1.0, d.z, part);
  clip_to(far - centre.z, -d.z, part);
  for (int i = 0; i < 2; i++) {
    clip_to(centre[i] - slopes[i] * centre.z, d[i] - slopes[i] * d.z, part);
    clip_to(slopes[i + 2] * centre.z - centre[i], slopes[i + 2] * d.z - d[i], part);
  }
  if (part.x >= part.y) return MISS;
  vec3 from = centre + part.x * d, to = centre + part.y * d;
  vec3 start = to_cube(from), end = to_cube(to);
  float size = length(end - start);
  if (!(size > 0.0 && size < FAR)) return MISS;
  // A perspective map is a Moebius map along a line.
  float c = size * to.z / (part.y - part.x);
  return CubeRay(start, (end - start) / size, 0.0, size, 0.0, vec3(part.x, from.z / c, d.z / c));
}

float asinh_of(float x) { return sign(x) * log(abs(x) + sqrt(x * x + 1.0)); }

float sinh_of(float x) { return 0.5 * (exp(x) - exp(-x)); }

CubeRay ray_in_contraction(vec3 along) {
  float to_nearest = -dot(centre, along);
  vec3 nearest = centre + to_nearest * along;
  float radii = max(length(nearest), 1.0);
  float enter = 0.25 * asinh_of((range.x - to_nearest) / radii);
  float leave = 0.25 * asinh_of((range.y - to_nearest) / radii);
  return CubeRay(nearest, along, enter, leave, radii, vec3(to_nearest, radii, 0.0));
}

CubeRay ray_of(vec3 along) {
  if (space == BOX) return ray_in_box(along);
  if (space == NDC) return ray_in_frustum(along);
  return ray_in_contraction(along);
}

// Returns the distance at t.
float distance_at(CubeRay ray, float t) {
  if (space == CONTRACTION) return ray.map.x + ray.map.y * sinh_of(4.0 * t);
  return ray.map.x + t * ray.map.y / (1.0 - t * ray.map.z);
}

// Returns the position at t in the unit cube, and the velocity, its derivative with respect to t.
vec3 position_at(CubeRay ray, float t, out vec3 velocity) {
  velocity = ray.direction;
  if (space != CONTRACTION) return ray.origin + t * ray.direction;
  float e = exp(4.0 * t);
  float along = 0.5 * ray.radii * (e - 1.0 / e), speed = 0.5 * ray.radii * (e + 1.0 / e);
  vec3 u = ray.origin + along * ray.direction;
  float inverse = 1.0 / length(u);
  if (inverse >= 1.0) {
    velocity *= speed;
    return 0.25 * u + 0.5;
  }
  float factor = (2.0 - inverse) * inverse;
  float change = 2.0 * (inverse - 1.0) * inverse * inverse * along * inverse;
  velocity = speed * (change * u + factor * ray.direction);
  return 0.25 * factor * u + 0.5;
}

// Bounds of a contracted ray's speed and change of velocity (`radiance`).
const float MAX_SPEED = 2.0, MAX_ACCELERATION = 12.0;
// Minimum speed for which a step's length is chosen: slower rays are near the contraction's border.
const float MIN_SPEED = 1.0 / 64.0;

// Returns the minimum increase of t after which a ray leaves the surrounding empty bricks, whose corners in the
// unit cube are `low` and `high`.
float way_out(vec3 at, vec3 velocity, vec3 low, vec3 high) {
  bvec3 stands = lessThan(abs(velocity), vec3(1e-7));
  vec3 ahead = mix(at - low, high - at, step(0.0, velocity)), speed = abs(velocity);
  if (space != CONTRACTION) {
    vec3 way = mix(ahead / speed, vec3(FAR), stands);
    return min(min(way.x, way.y), way.z);
  }
  // Roots of v * x + a * x * x / 2 = ahead, and of v * x - a * x * x / 2 = -behind.
  vec3 behind = mix(high - at, at - low, step(0.0, velocity));
  vec3 forth = 2.0 * max(ahead, 0.0) / (speed + sqrt(speed * speed + 2.0 * MAX_ACCELERATION * max(ahead, 0.0)) + 1e-9);
  vec3 back = (speed + sqrt(speed * speed + 2.0 * MAX_ACCELERATION * max(behind, 0.0))) / MAX_ACCELERATION;
  vec3 way = min(forth, back), wall = max(min(ahead, behind), 0.0);
  return max(min(min(way.x, way.y), way.z), min(min(wall.x, wall.y), wall.z) / MAX_SPEED);
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
  vec4 view;      // times `viewed`
  float viewed;   // share of the light whose view dependence was read
  float through;  // light that nothing stops
  float median;   // t at which half of it is stopped; negative where that never is
};

// Returns the length in voxels of the step after a sample of some opacity (docs/design/042): unbounded scenes
// have haze, which is smooth, and fields in NDC have few cells along z.
float stride_in(float opacity) {
  if (space == BOX || opacity <= 0.0) return space == NDC ? 2.0 : 1.0;
  return opacity < 0.05 ? 3.0 : space == NDC || opacity < 0.1 ? 2.0 : 1.0;
}

Seen march(CubeRay ray) {
  Seen seen = Seen(vec3(0), vec4(0), 0.0, 1.0, -FAR);
  float pending = 0.0;  // share of the light since view dependence was last read
  float stride = 1.0;
  float voxel = 1.0 / resolution;
  ivec3 last = ivec3(resolution) / 8 - 1, current = ivec3(-1);
  uvec4 brick;
  float t = ray.enter + 0.5 * voxel;
  for (int i = 0; i < MAX_STEPS && t < ray.leave && seen.through > DARK; i++) {
    vec3 velocity;
    vec3 at = clamp(position_at(ray, t, velocity) * resolution - 0.5, 0.0, resolution - 1.0);
    float h = voxel * stride;
    // Only contracted rays have another speed than 1.
    if (space == CONTRACTION) h /= max(length(velocity), MIN_SPEED);
    ivec3 own = min(ivec3(at) / 8, last);
    if (own != current) {
      brick = texelFetch(bricks, own, 0);
      reads++;
      current = own;
    }
    if (brick.a > 0u) {
      float empty = float(brick.a);
      vec3 low = 8.0 * (vec3(own) - empty + 1.0), high = 8.0 * (vec3(own) + empty);
      t += h * max(ceil(way_out(at * voxel, velocity, low * voxel, high * voxel) / h), 1.0);
      continue;
    }
    vec3 texel = (9.0 * vec3(brick.rgb) + at - 8.0 * vec3(own) + 0.5) / atlas_size;
    vec4 colour = texture(colours, texel);
    reads++;
    stride = stride_in(colour.a);
    if (colour.a > 0.0) {
      float kept = h == voxel ? 1.0 - colour.a : pow(1.0 - colour.a, h / voxel);
      float weight = seen.through * (1.0 - kept);
      seen.colour += weight / colour.a * colour.rgb;
      pending += weight;
      if (pending > VIEW_SHARE) {
        seen.view += pending / colour.a * texture(views, texel);
        seen.viewed += pending;
        pending = 0.0;
        reads++;
      }
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
  CubeRay ray = ray_of(along);
  Seen seen = march(ray);
  float opacity = 1.0 - seen.through;
  if (mode == READS) {
    shown = vec4(float(reads % 256) / 255.0, float(reads / 256) / 255.0, 0.0, 1.0);
  } else if (mode == OPACITY) {
    shown = vec4(vec3(opacity), 1.0);
  } else if (mode == PROBE) {
    // 24 bits of a number from 0, for no surface, to 1, for distance 0.
    float share = seen.median > -FAR ? depth_range.y / (depth_range.y + distance_at(ray, seen.median)) : 0.0;
    vec3 digits = floor(share * vec3(255.0, 65280.0, 16711680.0));
    shown = vec4(digits.x, digits.yz - 256.0 * digits.xy, 255.0) / 255.0;
  } else if (mode == DEPTH) {
    float z = -own.z * distance_at(ray, seen.median);
    // Colours are uniform in disparity, so that near depths have most of them.
    vec2 ends = 1.0 / depth_range;
    vec3 colour = of_depth((1.0 / z - ends.x) / (ends.y - ends.x));
    shown = vec4(seen.median > -FAR ? mix(background, colour, opacity) : background, 1.0);
  } else {
    vec3 colour = vec3(0);
    if (opacity > 1.0 / 512.0) {
      vec3 raw = logit(seen.colour / opacity) + view_part(seen.view / max(seen.viewed, 1e-6), along);
      colour = opacity / (1.0 + exp(-raw));
    }
    shown = vec4(colour + seen.through * background, 1.0);
  }
}
