// Operates a viewer's page like a user, and prints its states: viewer-controls.mjs PAGE [PNG FOLDER]
import { mkdirSync } from "node:fs";
import { accessibilityFindings, open, report } from "./browser.mjs";

const [file, written] = process.argv.slice(2);

/** In the page: waits until rendering ends; returns a hash of the pixels, the camera and the visible parts. */
async function state() {
  const viewer = await window.viewer;
  const pause = () => new Promise((resolve) => setTimeout(resolve, 30));
  while (viewer.isBusy || viewer.isMoving) await pause();
  const pixels = viewer.volume.pixels();
  let sum = 0;
  for (let i = 0; i < pixels.length; i++) sum = (31 * sum + pixels[i]) % 1000000007;
  const lines = document.getElementById("frusta");
  const copy = new OffscreenCanvas(lines.width, lines.height).getContext("2d");
  copy.drawImage(lines, 0, 0);
  const drawn = copy.getImageData(0, 0, lines.width, lines.height).data.some((v) => v > 0);
  return {
    hash: sum, camera: viewer.at, frusta: drawn,
    photograph: !document.getElementById("photograph").hidden,
    caption: document.getElementById("photo-name").textContent,
    title: document.querySelector("h1").textContent,
    angle: document.getElementById("angle-value").textContent,
    nearest: Math.min(...viewer.volume.distances(viewer.camera(1), 3, viewer.scene.size)) / viewer.scene.size,
    dialog: document.getElementById("help").open,
    scale: document.getElementById("depth-scale").hidden ? "" : document.getElementById("depth-scale").textContent,
    corner: [...viewer.volume.pixels().slice(0, 3)],
    path: viewer.path(), clicked: window.clicked,
    panes: ["view", "photo"].map((id) => {
      const { top, width, height } = document.getElementById(id).getBoundingClientRect();
      return [top, width, height];
    }),
    full: document.fullscreenElement?.id ?? "",
    centre: viewer.pose.map((row) => row[3]),
    right: viewer.pose.map((row) => row[0]),
  };
}

async function used(browser, name, options, act) {
  const { page, problems } = await open(browser, file, options);
  const states = { first: await page.evaluate(state) };
  for (const [what, doIt] of act(page)) {
    await doIt();
    states[what] = await page.evaluate(state);
    if (written) {
      mkdirSync(written, { recursive: true });
      await page.screenshot({ path: `${written}/${name}-${what}.png` });
    }
  }
  return { states, problems: [...problems, ...(await accessibilityFindings(page))] };
}

const onDesktop = (page) => [
  ["next", () => page.click("#next")],
  ["arrow", async () => { await page.focus("#view"); await page.keyboard.press("ArrowLeft"); }],
  ["frusta", () => page.check("#with-frusta")],
  ["wheel", async () => { await page.mouse.move(200, 300); await page.mouse.wheel(0, 400); }],
  ["drag", async () => { await page.mouse.down(); await page.mouse.move(260, 310, { steps: 3 }); await page.mouse.up(); }],
  ["depth", () => page.check("[value=depth]")],
  ["opacity", () => page.check("[value=opacity]")],
  ["keys", () => page.click("#show-help")],
  ["angle", async () => { await page.keyboard.press("Escape"); await page.focus("#view"); await page.keyboard.press("]"); }],
  ["turntable", async () => { await page.keyboard.press("t"); await page.waitForTimeout(300); await page.keyboard.press("t"); }],
  ["full", () => page.click("#full-screen")],
  ["saved", async () => {
    await page.focus("#view");
    await page.keyboard.press("f");
    const download = page.waitForEvent("download");
    await page.click("#save-image");
    const name = (await download).suggestedFilename();
    await page.evaluate((name) => (window.clicked = name), name);
  }],
  ["reset", async () => { await page.check("[value=colour]"); await page.uncheck("#with-frusta"); await page.click("#reset"); }],
  ["inside", async () => { await page.mouse.move(200, 250); for (let i = 0; i < 40; i++) await page.mouse.wheel(0, -300); }],
  ["home", () => page.click("#reset")],
  ["key", async () => {
    const download = page.waitForEvent("download");
    await page.click("#add-key");
    await page.click("#save-path");
    const target = process.argv[4];
    if (target) await (await download).saveAs(target);
  }],
  ["second", async () => { await page.click("#next"); await page.click("#add-key"); }],
  ["flown", async () => {
    await page.check("#with-frusta");
    const [x, y] = await page.evaluate(visibleFrustum);
    await page.mouse.click(x, y);
  }],
];

/** In the page: returns a point at which a training camera's frustum is drawn, and remembers the camera. */
async function visibleFrustum() {
  const viewer = await window.viewer;
  const box = viewer.canvas.getBoundingClientRect();
  for (let x = 40; x < box.width - 40; x += 4) {
    for (let y = 40; y < box.height - 40; y += 4) {
      window.clicked = viewer.frustumAt(box.left + x, box.top + y);
      if (window.clicked >= 0) return [box.left + x, box.top + y];
    }
  }
  throw new Error("no frustum is in view");
}

/** Moves touch points from one list of positions to another. */
async function touched(page, from, to) {
  const session = await page.context().newCDPSession(page);
  const send = (type, places) =>
    session.send("Input.dispatchTouchEvent", { type, touchPoints: places.map(([x, y], id) => ({ x, y, id })) });
  await send("touchStart", from);
  await send("touchMove", from.map(([x, y], i) => [(x + to[i][0]) / 2, (y + to[i][1]) / 2]));
  await send("touchMove", to);
  await send("touchEnd", []);
}

const onPhone = (page) => [
  ["finger", () => touched(page, [[150, 150]], [[210, 160]])],
  ["pinch", () => touched(page, [[150, 150], [200, 200]], [[110, 110], [240, 240]])],
];

await report({ webgl: true }, async (browser) => ({
  desktop: await used(browser, "desktop", { width: 800, height: 500 }, onDesktop),
  phone: await used(browser, "phone", { width: 390, height: 844, dark: true }, onPhone),
}));
