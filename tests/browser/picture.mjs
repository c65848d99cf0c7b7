// Takes pictures of pages, for the README: picture.mjs FILE.png PAGE [LABEL OF A BOX TO TICK FIRST]
//
// A viewer's page is given time to draw.
import { open, report } from "./browser.mjs";

const [file, path, label] = process.argv.slice(2);

await report({ webgl: true }, async (browser) => {
  const { page, problems } = await open(browser, path, { width: 1280, height: 900 });
  await page.evaluate(() => window.viewer);
  if (label) await page.getByLabel(label, { exact: true }).check();
  // Software draws a view of this size in some seconds.
  await page.waitForTimeout(label ? 20_000 : 2_000);
  await page.screenshot({ path: file });
  return { problems };
});
