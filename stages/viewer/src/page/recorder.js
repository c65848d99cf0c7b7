// Recorder of a camera path: keys, and the file that `camera-path` and nerfstudio read.

const FRAMES_PER_SECOND = 24;
const SECONDS_PER_KEY = 2;

class Recorder {
  constructor() { this.keys = []; }

  /** Adds a key: a pose and a vertical angle of view in degrees. */
  add(pose, angle) { this.keys.push({ pose, angle }); }

  clear() { this.keys = []; }

  /** Returns the frames of the path: all keys, with smooth motion between them. */
  frames() {
    const { keys } = this;
    const last = keys.length - 1;
    if (last < 1) return [...keys];
    const each = FRAMES_PER_SECOND * SECONDS_PER_KEY;
    const centre = (i) => column(keys[Math.max(0, Math.min(last, i))].pose, 3);
    const frames = [];
    for (let i = 0; i < last; i++) {
      const ends = [i - 1, i, i + 1, i + 2].map(centre);
      for (let k = 0; k < each; k++) {
        const share = k / each;
        frames.push({
          pose: between(keys[i].pose, keys[i + 1].pose, share, onCurve(ends, share)),
          angle: keys[i].angle + share * (keys[i + 1].angle - keys[i].angle),
        });
      }
    }
    return [...frames, keys[last]];
  }

  /** Returns the path in nerfstudio's format, for images of a width and height in pixels. */
  file(width, height) {
    const rows = (pose) => [...pose.flat(), 0, 0, 0, 1];
    const aspect = width / height;
    const frames = this.frames();
    return {
      camera_type: "perspective",
      render_width: width,
      render_height: height,
      fps: FRAMES_PER_SECOND,
      seconds: frames.length / FRAMES_PER_SECOND,
      is_cycle: false,
      smoothness_value: 0,
      default_fov: frames[0]?.angle ?? 50,
      default_transition_sec: SECONDS_PER_KEY,
      keyframes: this.keys.map(({ pose, angle }) => ({
        matrix: rows(pose), fov: angle, aspect,
        override_transition_enabled: false, override_transition_sec: null,
      })),
      camera_path: frames.map(({ pose, angle }) => ({ camera_to_world: rows(pose), fov: angle, aspect })),
    };
  }
}

/** Lets the user save a file. */
function saved(name, url) {
  const link = document.createElement("a");
  [link.download, link.href] = [name, url];
  link.click();
}
