// The page: camera, displayed content, and input.

const text = (id) => document.getElementById(id).textContent.trim();
const part = (id) => document.getElementById(id);

// Maximum milliseconds of a drawing during motion; slower views are drawn with fewer pixels.
const SMOOTH_MS = 40;
// Milliseconds after the last motion at which all pixels are drawn.
const STILL_MS = 180;
const MAX_PIXEL_RATIO = 2;

class Viewer {
  constructor(scene, bytes) {
    this.scene = scene;
    this.canvas = part("view");
    this.volume = new Volume(this.canvas, scene, bytes);
    this.mode = "colour";
    this.showsFrusta = false;
    // Milliseconds per drawn pixel.
    this.cost = 0;
    this.listen();
    this.goTo(scene.start);
  }

  /** Moves the view to a training camera. */
  goTo(index) {
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

  zoom(factor) { this.move(zoomed(this.pose, this.distance, factor), this.distance * factor); }

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
      await this.show(this.camera(ratio * less), this.mode);
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
      const points = frustumOf(other, 0.06 * this.scene.size).map((p) => projected(camera, p));
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

  /** Updates the camera's name, and shows the photograph of this or of the last camera that has one. */
  say() {
    if (this.at >= 0) this.last = this.at;
    const { name, photograph, photograph_size: size } = this.scene.cameras[this.last];
    part("camera").value = this.at >= 0 ? String(this.at) : "";
    part("photograph").hidden = !photograph || !part("compare").checked;
    part("photograph").classList.toggle("past", this.at < 0);
    document.body.classList.toggle("compares", !part("photograph").hidden);
    if (!photograph || part("photo").dataset.of === name) return;
    part("photo").dataset.of = name;
    part("photo").src = photograph;
    part("photo").alt = `LR photograph ${name}`;
    part("photo-name").textContent = `LR photograph ${name}, ${size.width}×${size.height}`;
  }

  listen() {
    const { canvas } = this;
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
    const middle = () => {
      const all = [...pointers.values()];
      const mean = (i) => all.reduce((sum, p) => sum + p[i], 0) / all.length;
      return [mean(0), mean(1), all.length > 1 ? Math.hypot(all[0][0] - all[1][0], all[0][1] - all[1][1]) : 0];
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
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
  async show(camera, mode = "colour") {
    const from = performance.now();
    this.volume.draw(camera, mode, this.depths(camera));
    await this.volume.finished();
    const time = performance.now() - from;
    this.cost = time / (this.canvas.width * this.canvas.height);
    return time;
  }

  /** Returns the view of a camera as a PNG's data URL. */
  image(camera, mode = "colour") {
    this.volume.draw(camera, mode, this.depths(camera));
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
