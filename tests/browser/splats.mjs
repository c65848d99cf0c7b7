// Renders a splat file in the GaussianSplats3D viewer from given cameras: splats.mjs SPLATS.ply VIEWS.json FOLDER.
//
// Writes each view to FOLDER/NAME.png, in the camera's size. Prints the number of splats that the viewer loaded, and the
// problems.
import { createRequire } from "node:module";
import { readFileSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { report } from "./browser.mjs";

const [splats, viewsFile, folder] = process.argv.slice(2);
const { views } = JSON.parse(readFileSync(viewsFile, "utf8"));
const packages = createRequire(`${process.env.NERF_SR_BROWSER}/`);
const three = dirname(packages.resolve("three"));
const viewer = dirname(packages.resolve("@mkkellogg/gaussian-splats-3d"));

// Browsers don't load modules from disk. No request reaches this host: `answer` serves all of them.
const ORIGIN = "http://viewer.invalid/";
const FILES = {
  "/three.module.js": join(three, "three.module.js"),
  "/three.core.js": join(three, "three.core.js"),
  "/viewer.js": join(viewer, "gaussian-splats-3d.module.js"),
  "/splats.ply": splats,
};
const PAGE = `<!doctype html><html lang=en><title>Splats</title><link rel=icon href=data:,>
  <script type=importmap>{"imports": {"three": "/three.module.js", "viewer": "/viewer.js"}}</script>`;

async function answer(route) {
  const path = new URL(route.request().url()).pathname;
  if (path === "/") return route.fulfill({ contentType: "text/html", body: PAGE });
  if (!(path in FILES)) return route.abort();
  const contentType = path.endsWith(".js") ? "text/javascript" : "application/octet-stream";
  return route.fulfill({ contentType, body: readFileSync(FILES[path]) });
}

// In the page: loads the file in a viewer of the given size, over white like the demo scene's images.
async function load({ width, height }) {
  const THREE = await import("three");
  const { SceneFormat, SceneRevealMode, Viewer } = await import("viewer");
  const renderer = new THREE.WebGLRenderer();
  renderer.setSize(width, height);
  renderer.setClearColor("white", 1);
  document.body.append(renderer.domElement);
  const camera = new THREE.PerspectiveCamera();
  const viewer = new Viewer({ renderer, camera, selfDrivenMode: false, useBuiltInControls: false,
    sharedMemoryForWorkers: false, ignoreDevicePixelRatio: true, sceneRevealMode: SceneRevealMode.Instant });
  await viewer.addSplatScene("/splats.ply", { format: SceneFormat.Ply, showLoadingUI: false });
  window.shown = { THREE, renderer, camera, viewer };
  return viewer.getSplatMesh().getSplatCount();
}

// In the page: renders a view and returns a PNG as data URL.
async function draw({ intrinsics, camera_to_world: pose }) {
  const { THREE, renderer, camera, viewer } = window.shown;
  camera.fov = (360 / Math.PI) * Math.atan((0.5 * intrinsics.height) / intrinsics.fy);
  camera.aspect = intrinsics.width / intrinsics.height;
  camera.near = 0.01;
  camera.updateProjectionMatrix();
  new THREE.Matrix4().set(...pose.flat(), 0, 0, 0, 1).decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  // The viewer sorts splats asynchronously, and only the nearest ones first; this waits and then sorts all splats.
  viewer.update();
  do {
    await new Promise((resolve) => setTimeout(resolve, 20));
  } while (viewer.sortRunning);
  await viewer.runSplatSort(true, true);
  while (viewer.sortRunning) await new Promise((resolve) => setTimeout(resolve, 20));
  viewer.update();
  viewer.render();
  return renderer.domElement.toDataURL("image/png");
}

await report({ webgl: true }, async (browser) => {
  const { width, height } = views[0].camera.intrinsics;
  const page = await browser.newPage({ viewport: { width, height } });
  const problems = [];
  page.on("pageerror", (error) => problems.push(error.message));
  await page.route("**/*", answer);
  await page.goto(ORIGIN);
  const count = await page.evaluate(load, { width, height });
  for (const { camera } of views) {
    const url = await page.evaluate(draw, camera);
    writeFileSync(join(folder, `${camera.name}.png`), Buffer.from(url.split(",")[1], "base64"));
  }
  return { count, problems };
});
