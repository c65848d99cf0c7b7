// Clears a WebGL2 canvas to orange and prints a pixel.
import { report } from "./browser.mjs";

await report({ webgl: true }, async (browser) => {
  const page = await browser.newPage();
  return page.evaluate(() => {
    const gl = document.createElement("canvas").getContext("webgl2");
    gl.clearColor(1, 0.498, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const pixel = new Uint8Array(4);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    return [...pixel];
  });
});
