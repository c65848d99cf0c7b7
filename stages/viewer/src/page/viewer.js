// The page: camera, displayed content, and input.

const text = (id) => document.getElementById(id).textContent.trim();
const part = (id) => document.getElementById(id);

// Maximum milliseconds of a drawing during motion; slower views are drawn with fewer pixels.
const SMOOTH_MS = 40;
// Milliseconds after the last motion at which all pixels are drawn.
const STILL_MS = 180;
const MAX_PIXEL_RATIO = 2;
// The page's colour (viewer.css).
const PAPER = { light: [244, 244, 245].map((byte) => byte / 255), dark: [28, 28, 30].map((byte) => byte / 255) };
// Milliseconds of a flight to a training camera, and of a turn of the turntable.
const FLIGHT_MS = 700;
const TURN_MS = 24000;
// Minimum distance of the camera from surfaces, over the scene's size and in voxels: nearer, it would be in them.
const SURFACE_MARGIN = 0.02;
const SURFACE_VOXELS = 3;
// Rays along each side of the view that look for surfaces ahead.
const PROBES = 3;
// Pixels between a click and a frustum's centre that still hit the frustum.
const CLICK_PIXELS = 24;
// Pixels of motion from which a press is no click.
const DRAG_PIXELS = 4;

// Controls that a key operates.
const KEYS = {
  c: "with-frusta", v: "compare", t: "turntable", f: "full-screen", s: "save-image", k: "add-key", "?": "show-help",
};

class Viewer {
  constructor(scene, bytes) {
    this.scene = scene;
    this.canvas = part("view");
    this.volume = new Volume(this.canvas, scene, bytes);
    this.mode = "colour";
    this.showsFrusta = false;
    this.recorder = new Recorder();
    this.isDark = matchMedia("(prefers-color-scheme: dark)");
    // Milliseconds per drawn pixel.
    this.cost = 0;
    this.listen();
    this.goTo(scene.start);
  }

  /** Moves the view to a training camera. */
  goTo(index) {
    this.flight = null;
    const count = this.scene.cameras.length;
    this.at = (index + count) % count;
    this.lens = this.scene.cameras[this.at].intrinsics;
    this.pose = this.scene.cameras[this.at].camera_to_world;
    const way = plus(this.scene.centre, column(this.pose, 3), -1);
    this.distance = Math.max(-dot(way, column(this.pose, 2)), 0.05 * this.scene.size);
    this.changed(false);
  }

  /** Moves away from the training cameras. */
  move(pose, distance = this.distance) {
    this.flight = null;
    this.at = -1;
    this.pose = pose;
    this.distance = distance;
    this.changed(true);
  }

  orbit(across, down) { this.move(orbited(this.pose, this.distance, this.scene.up, across, down)); }

  pan(right, up) {
    const unit = this.distance / this.camera(1).intrinsics.fx;
    this.move(panned(this.pose, -right * unit, up * unit));
  }

  /** Zooms: towards the surface in the middle of the view, if there is one, and no farther than just before the nearest one. */
  zoom(factor) {
    const { size } = this.scene;
    const distances = this.volume.distances(this.camera(1), PROBES, size);
    const middle = distances[(distances.length - 1) / 2];
    const ahead = factor < 1 && middle < Infinity ? middle : this.distance;
    const margin = Math.max(SURFACE_MARGIN * size, SURFACE_VOXELS * this.volume.voxel);
    const room = Math.max(0, Math.min(...distances) - margin);
    const way = Math.min(ahead * (1 - factor), room);
    this.move(zoomed(this.pose, ahead, 1 - way / ahead), Math.max(ahead - way, margin));
  }

  /** Flies to a training camera; without motion where the user prefers none. */
  fly(index) {
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) return this.goTo(index);
    const [from, lens, begin] = [this.pose, this.lens, performance.now()];
    const { camera_to_world: to, intrinsics } = this.scene.cameras[index];
    const flight = {};
    const frame = () => {
      if (this.flight !== flight) return;
      const share = Math.min(1, (performance.now() - begin) / FLIGHT_MS);
      if (share === 1) return this.goTo(index);
      const eased = share * share * (3 - 2 * share);
      const angle = angleOf(lens) + eased * (angleOf(intrinsics) - angleOf(lens));
      this.move(between(from, to, eased));
      this.lens = withAngle(intrinsics, angle);
      this.flight = flight;
      requestAnimationFrame(frame);
    };
    this.flight = flight;
    frame();
  }

  /** Starts or stops the turntable, which orbits around the up direction. */
  turn() {
    const isTurning = part("turntable").getAttribute("aria-pressed") !== "true";
    part("turntable").setAttribute("aria-pressed", isTurning);
    let before = performance.now();
    const frame = () => {
      if (part("turntable").getAttribute("aria-pressed") !== "true") return;
      const now = performance.now();
      this.orbit((2 * Math.PI * (now - before)) / TURN_MS, 0);
      before = now;
      requestAnimationFrame(frame);
    };
    if (isTurning) requestAnimationFrame(frame);
  }

  /** Sets the vertical angle of view in degrees. */
  setAngle(degrees) {
    this.lens = withAngle(this.lens, Math.max(10, Math.min(110, degrees)));
    this.move(this.pose);
  }

  /** Returns the colour behind the scene on the page: the page's own, unless the scene's is white in a light scheme, or black. */
  background() {
    const { background } = this.scene;
    if (background < 0.25 || (background > 0.75 && !this.isDark.matches)) return Array(3).fill(background);
    return this.isDark.matches ? PAPER.dark : PAPER.light;
  }

  /** Adds the view to the camera path. */
  addKey() {
    this.recorder.add(this.pose, angleOf(this.lens));
    this.sayPath();
  }

  sayPath() {
    const { length: count } = this.recorder.keys;
    part("save-path").disabled = part("clear-path").disabled = count === 0;
    part("path-length").textContent = count === 0 ? "" : `${count} ${count === 1 ? "key" : "keys"}`;
  }

  /** Returns the recorded camera path as the content of camera_path.json. */
  path() {
    const { film_width: width, cameras, start } = this.scene;
    const { intrinsics: k } = cameras[start];
    return this.recorder.file(width, Math.max(1, Math.round((width * k.height) / k.width)));
  }

  savePath() {
    const file = new Blob([JSON.stringify(this.path(), null, 1)], { type: "application/json" });
    const url = URL.createObjectURL(file);
    saved("camera_path.json", url);
    setTimeout(() => URL.revokeObjectURL(url), 10_000);
  }

  /** Saves the displayed view with all pixels. */
  saveImage() {
    const ratio = Math.min(devicePixelRatio || 1, MAX_PIXEL_RATIO);
    saved(`${this.scene.name}.png`, this.image(this.camera(ratio), this.mode, this.background()));
    this.changed(false);
  }

  fullScreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else part("stage").requestFullscreen?.();
  }

  /** Returns the view's camera, with `ratio` pixels per pixel of the page. */
  camera(ratio) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const size = [width, height].map((n) => Math.max(1, Math.round(n * ratio)));
    return { camera_to_world: this.pose, intrinsics: fitted(this.lens, ...size) };
  }

  /** Schedules a drawing: with fewer pixels during motion if necessary, and later with all of them. */
  changed(isMoving) {
    this.isMoving = isMoving;
    clearTimeout(this.still);
    if (isMoving) this.still = setTimeout(() => this.changed(false), STILL_MS);
    this.isStale = true;
    if (!this.isBusy) requestAnimationFrame(() => this.draw());
    this.isBusy = true;
  }

  /** Draws again until nothing has changed during a drawing. */
  async draw() {
    const ratio = Math.min(devicePixelRatio || 1, MAX_PIXEL_RATIO);
    while (this.isStale) {
      this.isStale = false;
      const time = this.cost * this.canvas.clientWidth * this.canvas.clientHeight * ratio ** 2;
      const less = this.isMoving && time > SMOOTH_MS ? Math.max(Math.sqrt(SMOOTH_MS / time), 0.15) : 1;
      this.drawFrusta();
      this.say();
      await this.show(this.camera(ratio * less), this.mode, this.background());
    }
    this.isBusy = false;
  }

  /** Returns the range of the depth colours, around the scene. */
  depths({ camera_to_world: pose }) {
    const { centre, size } = this.scene;
    const middle = length(plus(centre, column(pose, 3), -1));
    return [Math.max(middle - 0.5 * size, 0.1 * size), middle + 0.5 * size];
  }

  drawFrusta() {
    const lines = part("frusta");
    const context = lines.getContext("2d");
    const ratio = devicePixelRatio || 1;
    [lines.width, lines.height] = [lines.clientWidth * ratio, lines.clientHeight * ratio];
    if (!this.showsFrusta) return;
    const camera = this.camera(ratio);
    context.lineWidth = ratio;
    this.scene.cameras.forEach((other, i) => {
      if (i === this.at) return;
      const points = frustumOf(other, this.scene.frustum_depth).map((p) => projected(camera, p));
      if (points.some(([, , depth]) => depth < 1e-3 * this.scene.size)) return;
      const [apex, ...corners] = points;
      context.strokeStyle = i === this.last ? "#d22" : "#2a6fdb";
      context.beginPath();
      corners.forEach((corner, k) => {
        context.moveTo(apex[0], apex[1]);
        context.lineTo(corner[0], corner[1]);
        context.lineTo(corners[(k + 1) % 4][0], corners[(k + 1) % 4][1]);
      });
      context.stroke();
    });
  }

  /** Returns the training camera whose drawn frustum is at a point of the page, or -1. */
  frustumAt(x, y) {
    const box = this.canvas.getBoundingClientRect();
    const camera = this.camera(1);
    let [best, nearest] = [-1, CLICK_PIXELS];
    this.scene.cameras.forEach((other, i) => {
      if (i === this.at) return;
      const points = frustumOf(other, this.scene.frustum_depth).map((p) => projected(camera, p));
      if (points.some(([, , depth]) => depth <= 0)) return;
      const middle = [0, 1].map((c) => points.reduce((sum, p) => sum + p[c], 0) / points.length);
      const away = Math.hypot(middle[0] - (x - box.left), middle[1] - (y - box.top));
      if (away < nearest) [best, nearest] = [i, away];
    });
    return best;
  }

  /** Updates the camera's name, and shows the photograph of this or of the last camera that has one. */
  say() {
    if (this.at >= 0) this.last = this.at;
    this.sayScales();
    const { name, photograph, photograph_size: size } = this.scene.cameras[this.last];
    part("camera").value = this.at >= 0 ? String(this.at) : "";
    part("photograph").style.background = `rgb(${this.background().map((level) => 255 * level)})`;
    part("photograph").hidden = !photograph || !part("compare").checked;
    part("photograph").classList.toggle("past", this.at < 0);
    document.body.classList.toggle("compares", !part("photograph").hidden);
    if (!photograph || part("photo").dataset.of === name) return;
    part("photo").dataset.of = name;
    part("photo").src = photograph;
    part("photo").alt = `LR photograph ${name}`;
    part("photo-name").textContent = `LR photograph ${name}, ${size.width}×${size.height}`;
  }

  /** Updates angle of view, distance and the scale of depths. */
  sayScales() {
    const angle = Math.round(angleOf(this.lens));
    part("angle").value = angle;
    part("angle-value").textContent = `${angle}°`;
    const short = (x) => Number(x.toPrecision(3)).toString();
    part("distance").textContent = `${short(this.distance)} to the centre of rotation`;
    part("depth-scale").hidden = this.mode !== "depth";
    const [near, far] = this.depths(this.camera(1));
    [part("nearest").textContent, part("farthest").textContent] = [short(near), short(far)];
  }

  listen() {
    const { canvas } = this;
    this.isDark.addEventListener("change", () => this.changed(false));
    const buttons = {
      turntable: () => this.turn(), "full-screen": () => this.fullScreen(), "save-image": () => this.saveImage(),
      "show-help": () => part("help").showModal(), "add-key": () => this.addKey(), "save-path": () => this.savePath(),
      "clear-path": () => { this.recorder.clear(); this.sayPath(); },
    };
    for (const [id, act] of Object.entries(buttons)) part(id).addEventListener("click", act);
    part("angle").addEventListener("input", ({ target }) => this.setAngle(Number(target.value)));
    new ResizeObserver(() => this.changed(false)).observe(canvas);
    for (const radio of document.getElementsByName("mode")) {
      radio.addEventListener("change", () => { this.mode = radio.value; this.changed(false); });
    }
    part("with-frusta").addEventListener("change", ({ target }) => { this.showsFrusta = target.checked; this.changed(false); });
    part("compare").addEventListener("change", () => this.changed(false));
    part("camera").addEventListener("change", ({ target }) => { if (target.value) this.goTo(Number(target.value)); });
    part("previous").addEventListener("click", () => this.step(-1));
    part("next").addEventListener("click", () => this.step(1));
    part("reset").addEventListener("click", () => this.goTo(this.scene.start));
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(0.001 * Math.max(-300, Math.min(300, event.deltaY))));
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    this.listenToPointers();
  }

  /** Moves to the training camera that is `by` after the last one. */
  step(by) { this.goTo(this.last + by); }

  key(event) {
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (arrows && event.shiftKey) this.pan(20 * arrows[0], 20 * arrows[1]);
    else if (arrows) this.orbit(-0.08 * arrows[0], -0.08 * arrows[1]);
    else if (event.key === "+" || event.key === "=") this.zoom(0.9);
    else if (event.key === "-") this.zoom(1 / 0.9);
    else if (event.key === "[") this.setAngle(angleOf(this.lens) - 2);
    else if (event.key === "]") this.setAngle(angleOf(this.lens) + 2);
    else if ("123".includes(event.key)) document.getElementsByName("mode")[Number(event.key) - 1].click();
    else if (KEYS[event.key]) part(KEYS[event.key]).click();
    else if (event.key === "n") this.step(1);
    else if (event.key === "p") this.step(-1);
    else if (event.key === "Home") this.goTo(this.scene.start);
    else return;
    event.preventDefault();
  }

  /** One pointer orbits, or pans with Shift or another button; two pointers pan and zoom. */
  listenToPointers() {
    const { canvas } = this;
    const pointers = new Map();
    let pressed = null;
    const middle = () => {
      const all = [...pointers.values()];
      const mean = (i) => all.reduce((sum, p) => sum + p[i], 0) / all.length;
      return [mean(0), mean(1), all.length > 1 ? Math.hypot(all[0][0] - all[1][0], all[0][1] - all[1][1]) : 0];
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      pressed = [event.clientX, event.clientY];
    });
    canvas.addEventListener("click", ({ clientX: x, clientY: y }) => {
      const isClick = pressed && Math.hypot(x - pressed[0], y - pressed[1]) < DRAG_PIXELS;
      const found = this.showsFrusta && isClick ? this.frustumAt(x, y) : -1;
      if (found >= 0) this.fly(found);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!pointers.has(event.pointerId)) return;
      const before = middle();
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      const after = middle();
      const [x, y] = [after[0] - before[0], after[1] - before[1]];
      if (pointers.size > 1) {
        this.pan(x, y);
        if (before[2] > 0 && after[2] > 0) this.zoom(before[2] / after[2]);
      } else if (event.shiftKey || event.buttons !== 1) this.pan(x, y);
      else this.orbit((-4 * x) / canvas.clientHeight, (-4 * y) / canvas.clientHeight);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
    }
  }

  // Interface for scripts, such as tests.

  /** Draws the view of a camera, `{camera_to_world, intrinsics}` as in views.json; returns the milliseconds taken. */
  async show(camera, mode = "colour", background) {
    const from = performance.now();
    this.volume.draw(camera, mode, this.depths(camera), background);
    await this.volume.finished();
    const time = performance.now() - from;
    this.cost = time / (this.canvas.width * this.canvas.height);
    return time;
  }

  /** Returns the view of a camera as a PNG's data URL. */
  image(camera, mode = "colour", background) {
    this.volume.draw(camera, mode, this.depths(camera), background);
    return this.canvas.toDataURL("image/png");
  }

  /** Returns the mean number of texture reads per pixel of a camera's image. */
  reads(camera) {
    this.volume.draw(camera, "reads", this.depths(camera));
    const pixels = this.volume.pixels();
    let sum = 0;
    for (let i = 0; i < pixels.length; i += 4) sum += pixels[i] + 256 * pixels[i + 1];
    return sum / (pixels.length / 4);
  }
}

async function begin() {
  try {
    const scene = JSON.parse(text("scene"));
    const viewer = new Viewer(scene, await inflated(text("volume")));
    part("message").hidden = true;
    return viewer;
  } catch (error) {
    part("message").textContent = error.message;
    throw error;
  }
}

window.viewer = begin();
