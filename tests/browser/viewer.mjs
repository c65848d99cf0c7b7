// Compares a viewer's page with rendered views: viewer.mjs PAGE VIEWS [PNG FOLDER]
//
// VIEWS is an artifact of render-depth. For each view, prints the PSNR of the page's view from the same camera in dB, the
// PSNR of the mirrored view, and texture reads per pixel. With a folder, also prints milliseconds, and writes the page's views there.
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { accessibilityFindings, open, report } from "./browser.mjs";

const [file, folder, written] = process.argv.slice(2);

/** In the page: renders a camera's view and compares the pixels with a PNG. */
async function compared({ camera, expected, isTimed }) {
  const viewer = await window.viewer;
  const pixelsOf = async (url, isMirrored = false) => {
    const image = new Image();
    image.src = url;
    await image.decode();
    const { width, height } = image;
    const context = new OffscreenCanvas(width, height).getContext("2d");
    if (isMirrored) context.setTransform(-1, 0, 0, 1, width, 0);
    context.drawImage(image, 0, 0);
    return context.getImageData(0, 0, width, height).data;
  };
  const psnr = (a, b) => {
    let sum = 0;
    for (let i = 0; i < a.length; i++) sum += i % 4 < 3 ? (a[i] - b[i]) ** 2 : 0;
    return 10 * Math.log10((255 ** 2 * 0.75 * a.length) / sum);
  };
  // The second drawing is timed: the first one also compiles.
  if (isTimed) await viewer.show(camera);
  const milliseconds = isTimed ? await viewer.show(camera) : undefined;
  const image = viewer.image(camera);
  const own = await pixelsOf(expected);
  return {
    name: camera.name,
    psnr: psnr(own, await pixelsOf(image)),
    mirrored: psnr(own, await pixelsOf(image, true)),
    reads: viewer.reads(camera),
    milliseconds,
    image,
  };
}

await report({ webgl: true }, async (browser) => {
  const { page, problems } = await open(browser, file, { width: 512, height: 512 });
  const { views } = JSON.parse(readFileSync(`${folder}/views.json`, "utf8"));
  const results = [];
  for (const { camera } of views) {
    const png = readFileSync(`${folder}/previews/${camera.name}.png`).toString("base64");
    const { image, ...result } = await page.evaluate(compared, { camera, expected: `data:image/png;base64,${png}`, isTimed: Boolean(written) });
    results.push(result);
    if (written) {
      mkdirSync(written, { recursive: true });
      writeFileSync(`${written}/${camera.name}.png`, Buffer.from(image.split(",")[1], "base64"));
    }
  }
  return { views: results, problems: [...problems, ...(await accessibilityFindings(page))] };
});
