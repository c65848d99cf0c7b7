"use strict";
// Comparison of pictures: two of a view with a division between them, or many side by side. All share zoom and pan,
// which stay when the view changes.

/** Maximum number of pictures side by side. */
const MAX_PANES = 24;
/** Maximum distance in screen pixels at which a drag moves the divider instead of panning. */
const GRIP = 18;
const MAX_ZOOM = 40;
/** Time after the last change until the address is written: browsers ignore more than some 20 writes a second. */
const LINK_DELAY_MS = 250;

class Comparison {
  constructor(data, changed) {
    this.data = data;
    this.changed = changed;
    this.pictures = new Map(data.pictures.map((picture) => [`${picture.view}/${picture.layer}`, picture]));
    this.views = [...new Set(data.pictures.map((picture) => picture.view))].sort((a, b) => a - b);
    this.hasOriginals = true;
    this.pointers = new Map();
    this.state = {
      view: data.view,
      left: -1,
      right: -1,
      kind: "render",
      grid: false,
      zoom: 1,
      x: 0.5,
      y: 0.5,
      split: 0.5,
    };
    this.part = (id) => document.getElementById(id);
    this.container = this.part("panes");
    this.part("comparison").hidden = false;
    this.fillViews();
    this.fillThumbnails();
    this.listen();
    this.show({});
    if (data.crop) this.showCrop(data.crop);
    this.openLink();
    addEventListener("hashchange", () => this.openLink());
  }

  // Choices.

  fillViews() {
    const { scenes, views } = this.data;
    const groups = scenes.map((label) => element("optgroup", { label }));
    for (const view of this.views) element("option", { value: view }, groups[views[view].scene], views[view].name);
    const shown = groups.filter((group) => group.children.length);
    this.part("view").replaceChildren(...(shown.length > 1 ? shown : [...shown[0].children]));
  }

  /** One small picture of each view: the best render, or else its first picture. */
  fillThumbnails() {
    const { views, rows, layers, best, pictures } = this.data;
    const isBest = ({ layer }) => layers[layer].kind === "render" && layers[layer].rows.includes(best);
    this.thumbnails = this.views.map((view) => {
      const own = pictures.filter((picture) => picture.view === view);
      const isRender = ({ layer }) => layers[layer].kind === "render";
      const picture = (rows.length ? own.find(isBest) : null) ?? own.find(isRender) ?? own[0];
      const button = element("button", { type: "button", title: views[view].name });
      element("img", { src: picture.uri, alt: `View ${views[view].name}`, loading: "lazy" }, button);
      button.addEventListener("click", () => this.show({ view }));
      return button;
    });
    this.part("thumbnails").replaceChildren(...this.thumbnails);
    this.part("thumbnails").hidden = this.views.length < 2;
  }

  /** Returns the layers with a picture of the view. */
  layers() {
    const { view } = this.state;
    return this.data.layers
      .map((layer, index) => ({ ...layer, index }))
      .filter(({ index }) => this.picture(index, view));
  }

  picture(layer, view = this.state.view) {
    return this.pictures.get(`${view}/${layer}`);
  }

  /** Keeps available layers; replaces missing ones by the LR photograph and the best render. */
  chooseLayers() {
    const { state } = this;
    const layers = this.layers();
    const has = (index) => layers.some((layer) => layer.index === index);
    const old = this.data.layers;
    const like = (index) =>
      layers.find(({ kind, label }) => kind === old[index]?.kind && label === old[index]?.label)?.index;
    const first = (...kinds) => kinds.map((kind) => layers.find((layer) => layer.kind === kind)).find(Boolean)?.index;
    const best = layers.find(({ kind, rows }) => kind === "render" && rows.includes(this.data.best))?.index;
    if (!has(state.left)) state.left = like(state.left) ?? first("low-resolution", "ground-truth") ?? layers[0].index;
    if (!has(state.right)) state.right = like(state.right) ?? best ?? first("render", "error") ?? layers.at(-1).index;
    const groups = new Map(layers.map(({ group }) => [group, []]));
    layers.forEach((layer) => groups.get(layer.group).push(layer));
    for (const side of ["left", "right"]) {
      const options = [...groups].map(([label, members]) => {
        const group = element("optgroup", { label });
        members.forEach((layer) => element("option", { value: layer.index }, group, this.name(layer)));
        return group;
      });
      this.part(side).replaceChildren(...options);
      this.part(side).value = state[side];
    }
    const kinds = [...new Map(layers.map(({ kind, group }) => [kind, group]))].filter(
      ([kind]) => !["low-resolution", "ground-truth"].includes(kind),
    );
    this.part("kind").replaceChildren(...kinds.map(([kind, group]) => element("option", { value: kind }, null, group)));
    if (!kinds.some(([kind]) => kind === state.kind)) state.kind = kinds[0]?.[0];
    this.part("kind").value = state.kind;
  }

  /** Returns a layer's full name; a metric's title is cut before its brackets. */
  name({ kind, group, label }) {
    if (["low-resolution", "ground-truth", "render"].includes(kind)) return label;
    const words = { error: "Error", depth: "Depth" }[kind] ?? group.split(" (")[0];
    return label === "Render" ? words : `${words}: ${label}`;
  }

  // Display.

  show(change) {
    Object.assign(this.state, change);
    if ("view" in change || !this.panes) this.chooseLayers();
    const { state } = this;
    this.part("view").value = state.view;
    for (const side of ["left", "right"]) this.part(side).value = state[side];
    this.part("comparison").classList.toggle("grid", state.grid);
    this.part("slider-mode").setAttribute("aria-pressed", String(!state.grid));
    this.part("grid-mode").setAttribute("aria-pressed", String(state.grid));
    if (state.grid) this.buildGrid();
    else this.buildSlider();
    this.place();
    this.showScales();
    this.showNumbers();
    this.showOriginals();
    this.showThumbnail();
    this.changed(state);
  }

  showThumbnail() {
    const shown = this.views.indexOf(this.state.view);
    this.thumbnails.forEach((button, i) => button.setAttribute("aria-pressed", String(i === shown)));
    const [button, strip] = [this.thumbnails[shown], this.part("thumbnails")];
    strip.scrollLeft = button.offsetLeft - (strip.clientWidth - button.offsetWidth) / 2;
  }

  // Links.

  /** Returns the state as the fragment of a link: names, so that it fits a page of a later run. */
  linkText() {
    const { state, data } = this;
    const name = (layer) => `${data.layers[layer].kind}/${data.layers[layer].label}`;
    const link = new URLSearchParams({ view: data.views[state.view].name });
    if (data.scenes.length > 1) link.set("set", data.scenes[data.views[state.view].scene]);
    if (state.grid) link.set("pictures", state.kind);
    else for (const side of ["left", "right"]) link.set(side, name(state[side]));
    for (const key of ["zoom", "x", "y", "split"]) link.set(key, String(Number(state[key].toFixed(4))));
    return `#${link}`;
  }

  /** Writes the link of the state to the address soon, which a reader may copy or bookmark. */
  keepLink() {
    if (!this.isReady) return;
    clearTimeout(this.linkTimer);
    this.linkTimer = setTimeout(() => {
      try {
        history.replaceState(null, "", this.linkText());
      } catch {
        // Some browsers refuse this for files.
      }
    }, LINK_DELAY_MS);
  }

  /** Shows what the address' fragment names. */
  openLink() {
    this.isReady = true;
    const link = new URLSearchParams(location.hash.slice(1));
    const { views, scenes, layers } = this.data;
    const isNamed = (view) =>
      views[view].name === link.get("view") && (!link.has("set") || scenes[views[view].scene] === link.get("set"));
    const view = this.views.find(isNamed);
    if (view === undefined) return;
    this.show({ view, grid: link.has("pictures"), ...(link.has("pictures") && { kind: link.get("pictures") }) });
    const layer = (side) =>
      this.layers().find(({ kind, label }) => `${kind}/${label}` === link.get(side))?.index ?? this.state[side];
    const number = (key, otherwise) => {
      const value = Number.parseFloat(link.get(key));
      return Number.isFinite(value) ? value : otherwise;
    };
    this.show({ left: layer("left"), right: layer("right") });
    const split = Math.min(Math.max(number("split", 0.5), 0), 1);
    this.move({ zoom: number("zoom", 1), x: number("x", 0.5), y: number("y", 0.5), split });
    this.part("compare").scrollIntoView({ block: "start" });
  }

  async copyLink() {
    const link = location.href.split("#")[0] + this.linkText();
    try {
      await navigator.clipboard.writeText(link);
      this.part("link").textContent = "Copied";
    } catch {
      this.part("link").textContent = "In the address";
    }
  }

  /** Creates the window of one picture within a pane. */
  window(layer, parent) {
    const picture = this.picture(layer);
    const half = element("div", { class: "half" }, parent);
    const image = element("img", { src: picture.uri, alt: "", draggable: "false" }, half);
    return { half, image, picture, kind: this.data.layers[layer].kind, isSharp: false };
  }

  pane(layer) {
    const { width, height } = this.picture(layer);
    const pane = element("div", { class: "pane" });
    pane.style.aspectRatio = `${width} / ${height}`;
    pane.style.setProperty("--aspect", width / height);
    return pane;
  }

  buildSlider() {
    const { left, right } = this.state;
    const pane = this.pane(right);
    const windows = [this.window(right, pane), this.window(left, pane)];
    this.divider = element("div", { class: "divider" }, pane);
    element("span", { class: "tag left" }, pane, this.name(this.data.layers[left]));
    element("span", { class: "tag right" }, pane, this.name(this.data.layers[right]));
    this.panes = [{ pane, windows }];
    this.container.replaceChildren(pane);
    const [one, other] = [left, right].map((layer) => this.name(this.data.layers[layer]));
    this.container.setAttribute(
      "aria-label",
      `View ${this.data.views[this.state.view].name}: left ${one}, right ${other}`,
    );
  }

  buildGrid() {
    const kinds = ["low-resolution", this.state.kind, "ground-truth"];
    const isChosen = ({ index }) => index === this.state.left || index === this.state.right;
    const all = kinds.flatMap((kind) => this.layers().filter((layer) => layer.kind === kind));
    const some =
      all.length > MAX_PANES
        ? [...all.filter(isChosen), ...all.filter((layer) => !isChosen(layer))].slice(0, MAX_PANES)
        : all;
    const figure = this.data.figures[0];
    this.panes = [];
    const figures = some.map((layer) => {
      const pane = this.pane(layer.index);
      this.panes.push({ pane, windows: [this.window(layer.index, pane)] });
      const made = element("figure", {});
      const score = this.data.rows[layer.rows[0]]?.scores[this.state.view]?.[0];
      const words =
        score == null
          ? ""
          : ` · ${score.toFixed(figure.digits)} ${figure.label.split(" ").at(-1) === "dB" ? "dB" : ""}`;
      made.append(pane, element("figcaption", {}, null, this.name(layer) + words));
      return made;
    });
    if (some.length < all.length)
      figures.push(
        element(
          "p",
          { class: "note" },
          null,
          `${some.length} of ${all.length} pictures; the sliders show all of them.`,
        ),
      );
    this.container.replaceChildren(...figures);
    this.container.setAttribute(
      "aria-label",
      `View ${this.data.views[this.state.view].name}: ${some.length} pictures side by side`,
    );
  }

  /** Positions the pictures by zoom and pan. */
  place() {
    const { state } = this;
    this.limit();
    for (const { pane, windows } of this.panes) {
      const [width, height] = [pane.clientWidth, pane.clientHeight];
      const [x, y] = [width * (0.5 - state.x * state.zoom), height * (0.5 - state.y * state.zoom)];
      for (const window of windows) {
        const { image, picture, kind } = window;
        image.style.transform = `translate(${x}px, ${y}px) scale(${state.zoom})`;
        const times = (width * state.zoom) / (window.isSharp ? picture.width : picture.shownWidth);
        image.classList.toggle("pixels", times > (kind === "low-resolution" ? 1 : 2));
        if (state.zoom > 1.05) this.sharpen(window);
      }
    }
    const first = this.panes[0];
    if (!state.grid) {
      first.windows[1].half.style.clipPath = `inset(0 ${100 - 100 * state.split}% 0 0)`;
      this.divider.style.left = `${100 * state.split}%`;
    }
    this.part("split").value = 100 * state.split;
    const per = (first.pane.clientWidth * state.zoom) / first.windows[0].picture.width;
    this.part("zoom").textContent = `${Math.round(100 * per)} %`;
    this.container.classList.toggle("zoomed", state.zoom > 1);
    this.keepLink();
  }

  limit() {
    const { state } = this;
    const one = this.oneToOne();
    state.zoom = Math.min(Math.max(state.zoom, Math.min(1, one)), Math.max(8, MAX_ZOOM * one));
    const edge = state.zoom > 1 ? 0.5 / state.zoom : 0.5;
    state.x = Math.min(Math.max(state.x, edge), 1 - edge);
    state.y = Math.min(Math.max(state.y, edge), 1 - edge);
  }

  /** Returns the zoom at which a pixel of the first picture is a pixel of the screen. */
  oneToOne() {
    const { pane, windows } = this.panes[0];
    return windows[0].picture.width / Math.max(1, pane.clientWidth);
  }

  /** Replaces smaller copies by originals, if available. */
  sharpen(window) {
    const { image, picture } = window;
    if (!this.hasOriginals || window.isSharp || window.isLoading || picture.uri.startsWith("data:image/png")) return;
    window.isLoading = true;
    const original = new Image();
    original.onload = () => {
      window.isSharp = true;
      image.src = original.src;
      this.place();
    };
    original.onerror = () => (this.hasOriginals = false);
    original.src = picture.original;
  }

  shown() {
    return this.state.grid
      ? this.layers().filter(({ kind }) => kind === this.state.kind)
      : [this.state.left, this.state.right].map((index) => ({ ...this.data.layers[index], index }));
  }

  showScales() {
    const scales = [...new Set(this.shown().map(({ scale }) => scale))].filter((scale) => scale !== null);
    this.part("scales").replaceChildren(
      ...scales.map((index) => {
        const { label, colours, ticks } = this.data.scales[index];
        const figure = element("figure", { class: "scale" });
        element("div", { class: "bar", style: `background:linear-gradient(to right,${colours.join(",")})` }, figure);
        const line = element("div", { class: "ticks" }, figure);
        for (const [place, text] of ticks) element("span", { style: `left:${100 * place}%` }, line, text);
        element("figcaption", {}, figure, label);
        return figure;
      }),
    );
  }

  showNumbers() {
    const { figures, rows, views } = this.data;
    const of = this.shown().flatMap((layer) => layer.rows);
    const shown = [...new Set(of.length ? of : [this.data.best])].filter((row) => rows[row]?.scores[this.state.view]);
    const table = this.part("numbers");
    table.replaceChildren(element("caption", {}, null, `Numbers of view ${views[this.state.view].name}`));
    if (!shown.length) return;
    const head = element("tr", {}, element("thead", {}, table));
    element("th", { scope: "col" }, head, "Result");
    figures.forEach(({ label, definition }) =>
      element("th", { scope: "col", class: "n", title: definition }, head, label),
    );
    const body = element("tbody", {}, table);
    for (const row of shown) {
      const line = element("tr", {}, body);
      breakable(element("th", { scope: "row" }, line), rows[row].label);
      rows[row].scores[this.state.view].forEach((value, i) =>
        element("td", { class: "n" }, line, value === null ? "–" : value.toFixed(figures[i].digits)),
      );
    }
  }

  showOriginals() {
    const home = this.part("originals");
    home.replaceChildren("Originals in the folder beside this page: ");
    const shown = this.state.grid ? [] : [...new Set([this.state.left, this.state.right])];
    home.hidden = !shown.length;
    shown.forEach((index, i) => {
      const { original, width, height } = this.picture(index);
      if (i) home.append(" · ");
      element("a", { href: original }, home, `${this.name(this.data.layers[index])}, ${width} × ${height}`);
    });
  }

  // Input.

  listen() {
    const number = (event) => Number(event.target.value);
    this.part("view").addEventListener("change", (event) => this.show({ view: number(event) }));
    this.part("left").addEventListener("change", (event) => this.show({ left: number(event) }));
    this.part("right").addEventListener("change", (event) => this.show({ right: number(event) }));
    this.part("kind").addEventListener("change", (event) => this.show({ kind: event.target.value }));
    this.part("split").addEventListener("input", (event) => this.move({ split: number(event) / 100 }));
    const clicks = {
      previous: () => this.step(-1),
      next: () => this.step(1),
      fit: () => this.fit(),
      "one-to-one": () => this.showOneToOne(),
      "zoom-in": () => this.zoomBy(1.5),
      "zoom-out": () => this.zoomBy(1 / 1.5),
      "slider-mode": () => this.show({ grid: false }),
      "grid-mode": () => this.show({ grid: true }),
      link: () => this.copyLink(),
    };
    for (const [id, act] of Object.entries(clicks)) this.part(id).addEventListener("click", act);
    this.container.addEventListener("keydown", (event) => this.key(event));
    this.container.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.container.addEventListener("dblclick", () => (this.state.zoom === 1 ? this.showOneToOne() : this.fit()));
    this.container.addEventListener("pointerdown", (event) => this.press(event));
    this.container.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"])
      this.container.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    new ResizeObserver(() => this.place()).observe(this.container);
  }

  move(change) {
    Object.assign(this.state, change);
    this.place();
  }

  step(by) {
    const place = this.views.indexOf(this.state.view) + by;
    this.show({ view: this.views[(place + this.views.length) % this.views.length] });
  }

  fit() {
    this.move({ zoom: 1, x: 0.5, y: 0.5 });
  }

  showOneToOne() {
    this.move({ zoom: this.oneToOne() });
  }

  showCrop([x, y, side]) {
    const { width, height } = this.panes[0].windows[0].picture;
    this.move({ zoom: Math.min(width, height) / side, x: (x + side / 2) / width, y: (y + side / 2) / height });
  }

  /** Zooms about a position in the pane, from its upper left (0, 0) to its lower right corner (1, 1). */
  zoomBy(times, [atX, atY] = [0.5, 0.5]) {
    const { zoom, x, y } = this.state;
    this.state.zoom = zoom * times;
    this.limit();
    const after = this.state.zoom;
    this.move({ x: x + (atX - 0.5) * (1 / zoom - 1 / after), y: y + (atY - 0.5) * (1 / zoom - 1 / after) });
  }

  /** Returns the pane under a pointer, and the position in it. */
  under(event) {
    const pane = event.target.closest(".pane") ?? this.panes[0].pane;
    const box = pane.getBoundingClientRect();
    return { box, at: [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height] };
  }

  /** The wheel zooms with Ctrl (a trackpad's pinch sets it), or after the panes have got the focus. */
  wheel(event) {
    if (!event.ctrlKey && !event.metaKey && document.activeElement !== this.container) return;
    event.preventDefault();
    this.zoomBy(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.002)), this.under(event).at);
  }

  press(event) {
    if (event.button || !event.target.closest(".pane")) return;
    const { box, at } = this.under(event);
    const isNear = Math.abs(at[0] - this.state.split) * box.width < GRIP;
    this.pulls = !this.state.grid && (isNear || this.state.zoom <= 1);
    this.pointers.set(event.pointerId, event);
    this.container.setPointerCapture(event.pointerId);
    if (this.pulls && this.pointers.size === 1) this.move({ split: Math.min(Math.max(at[0], 0), 1) });
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const { box } = this.under({ target: before.target, clientX: event.clientX, clientY: event.clientY });
    if (this.pointers.size === 2) this.pinch(event, before, box);
    else if (this.pulls) this.move({ split: Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1) });
    else this.pan(event.clientX - before.clientX, event.clientY - before.clientY, box);
    this.pointers.set(event.pointerId, { target: before.target, clientX: event.clientX, clientY: event.clientY });
  }

  pan(x, y, box) {
    const { state } = this;
    this.move({ x: state.x - x / (box.width * state.zoom), y: state.y - y / (box.height * state.zoom) });
  }

  pinch(event, before, box) {
    const [, other] = [...this.pointers].find(([id]) => id !== event.pointerId);
    const far = (point) => Math.hypot(point.clientX - other.clientX, point.clientY - other.clientY);
    const middle = [(event.clientX + other.clientX) / 2, (event.clientY + other.clientY) / 2];
    this.zoomBy(far(event) / Math.max(1, far(before)), [
      (middle[0] - box.left) / box.width,
      (middle[1] - box.top) / box.height,
    ]);
    this.pan((event.clientX - before.clientX) / 2, (event.clientY - before.clientY) / 2, box);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { state } = this;
    const by = 0.1 / state.zoom;
    const sideways = (sign) =>
      state.zoom > 1 || state.grid
        ? this.move({ x: state.x + sign * by })
        : this.move({ split: Math.min(Math.max(state.split + sign * 0.02, 0), 1) });
    const keys = {
      "+": () => this.zoomBy(1.25),
      "=": () => this.zoomBy(1.25),
      "-": () => this.zoomBy(0.8),
      0: () => this.fit(),
      1: () => this.showOneToOne(),
      ArrowLeft: () => sideways(-1),
      ArrowRight: () => sideways(1),
      n: () => this.step(1),
      p: () => this.step(-1),
    };
    if (state.zoom > 1)
      Object.assign(keys, {
        ArrowUp: () => this.move({ y: state.y - by }),
        ArrowDown: () => this.move({ y: state.y + by }),
      });
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }
}
