// Cameras: three rows [right, up, back, centre], as in views.json.

const column = (m, c) => m.map((row) => row[c]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, times = 1) => a.map((x, i) => x + times * b[i]);
const scaled = (a, times) => a.map((x) => x * times);
const length = (a) => Math.sqrt(dot(a, a));
const unit = (a) => scaled(a, 1 / Math.max(length(a), 1e-12));

/** Rotates a vector about a unit axis (Rodrigues). */
function turned(v, axis, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const across = [
    axis[1] * v[2] - axis[2] * v[1], axis[2] * v[0] - axis[0] * v[2], axis[0] * v[1] - axis[1] * v[0]];
  const along = dot(axis, v) * (1 - c);
  return v.map((x, i) => x * c + across[i] * s + axis[i] * along);
}

/** Converts columns to rows. */
const poseOf = (columns) => [0, 1, 2].map((i) => columns.map((v) => v[i]));

/** Rotates a pose about the point at `distance` in front of it: by `across` about `up`, by `down` about its right axis. */
function orbited(pose, distance, up, across, down) {
  const [right, above, back, centre] = [0, 1, 2, 3].map((c) => column(pose, c));
  const target = plus(centre, back, -distance);
  const turn = (v) => turned(turned(v, right, down), up, across);
  // The pose stays below the pole, where left and right would be exchanged.
  const next = turn(back);
  const steep = Math.abs(dot(next, up)) > 0.999 && Math.abs(dot(next, up)) > Math.abs(dot(back, up));
  if (steep || dot(turn(above), up) * dot(above, up) < 0) return down === 0 ? pose : orbited(pose, distance, up, across, 0);
  return poseOf([turn(right), turn(above), next, plus(target, next, distance)]);
}

/** Moves a pose sideways and upwards. */
function panned(pose, right, up) {
  const centre = plus(plus(column(pose, 3), column(pose, 0), right), column(pose, 1), up);
  return pose.map((row, i) => [...row.slice(0, 3), centre[i]]);
}

/** Moves a pose towards the point at `distance` in front of it, so that `factor` times the distance remains. */
function zoomed(pose, distance, factor) {
  const centre = plus(column(pose, 3), column(pose, 2), distance * (factor - 1));
  return pose.map((row, i) => [...row.slice(0, 3), centre[i]]);
}

/** Returns intrinsics with which a camera's whole image fits into the given number of pixels. */
function fitted({ width: w, height: h, fx, fy, cx, cy }, width, height) {
  const scale = Math.min(width / w, height / h);
  return {
    width, height, fx: fx * scale, fy: fy * scale,
    cx: width / 2 + (cx - w / 2) * scale, cy: height / 2 + (cy - h / 2) * scale,
  };
}

/** Projects a point: x and y in pixels, and depth. */
function projected({ camera_to_world: pose, intrinsics: k }, point) {
  const from = plus(point, column(pose, 3), -1);
  const [x, y, z] = [0, 1, 2].map((c) => dot(from, column(pose, c)));
  return [k.cx - (k.fx * x) / z, k.cy + (k.fy * y) / z, -z];
}

/** Returns a camera's frustum: its centre and its image's corners at a depth. */
function frustumOf({ camera_to_world: pose, intrinsics: k }, depth) {
  const corner = ([u, v]) => {
    const own = [((u - k.cx) / k.fx) * depth, (-(v - k.cy) / k.fy) * depth, -depth];
    return pose.map((row) => row[3] + dot(row, own));
  };
  return [column(pose, 3), ...[[0, 0], [k.width, 0], [k.width, k.height], [0, k.height]].map(corner)];
}

/** Returns intrinsics with another vertical angle of view, in degrees, and the principal point in the middle. */
function withAngle({ width, height }, degrees) {
  const f = height / 2 / Math.tan((degrees * Math.PI) / 360);
  return { width, height, fx: f, fy: f, cx: width / 2, cy: height / 2 };
}

/** Returns the vertical angle of view of intrinsics, in degrees. */
const angleOf = ({ height, fy }) => (360 / Math.PI) * Math.atan(height / 2 / fy);

/** Returns a pose's rotation as a unit quaternion [x, y, z, w]. */
function quaternionOf(m) {
  const [[a, b, c], [d, e, f], [g, h, i]] = m;
  const all = [
    [1 + a - e - i, b + d, c + g, h - f], [b + d, 1 - a + e - i, f + h, c - g],
    [c + g, f + h, 1 - a - e + i, d - b], [h - f, c - g, d - b, 1 + a + e + i]];
  // Of four equal vectors, the longest has the smallest error.
  const best = all.reduce((x, y, k) => (y[k] > x[0] ? [y[k], y] : x), [0, all[3]])[1];
  const size = Math.hypot(...best);
  return best.map((x) => x / size);
}

/** Returns the columns of a quaternion's rotation. */
function axesOf([x, y, z, w]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
    [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
    [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)]];
}

/** Interpolates two poses: the centre along `centre`, or straight, and the rotation along the shorter arc. */
function between(from, to, share, centre) {
  const p = quaternionOf(from);
  let q = quaternionOf(to);
  let cosine = p.reduce((sum, x, i) => sum + x * q[i], 0);
  if (cosine < 0) [q, cosine] = [q.map((x) => -x), -cosine];
  const angle = Math.acos(Math.min(cosine, 1));
  const part = (x) => (angle < 1e-6 ? x : Math.sin(x * angle) / Math.sin(angle));
  const mixed = p.map((x, i) => part(1 - share) * x + part(share) * q[i]);
  const size = Math.hypot(...mixed);
  const [a, b] = [column(from, 3), column(to, 3)];
  return poseOf([...axesOf(mixed.map((x) => x / size)), centre ?? plus(a, plus(b, a, -1), share)]);
}

/** Returns the point of the Catmull-Rom curve through b and c at a share of the way between them. */
function onCurve([a, b, c, d], t) {
  return b.map((x, i) => 0.5 * (2 * x + (c[i] - a[i]) * t + (2 * a[i] - 5 * x + 4 * c[i] - d[i]) * t * t
    + (3 * (x - c[i]) + d[i] - a[i]) * t ** 3));
}
