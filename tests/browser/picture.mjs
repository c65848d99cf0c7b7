// Writes a screenshot of a page, for the README: picture.mjs FILE.png PAGE [LABEL OF A CHECKBOX TO TICK FIRST]
import { open, report } from "./browser.mjs";

const [file, path, label] = process.argv.slice(2);

await report({ webgl: true }, async (browser) => {
  const { page, problems } = await open(browser, path, { width: 1280, height: 900 });
  await page.evaluate(() => window.viewer);
  if (label) await page.getByLabel(label, { exact: true }).check();
  // The software renderer takes several seconds for a view of this size.
  await page.waitForTimeout(label ? 20_000 : 2_000);
  await page.screenshot({ path: file });
  return { problems };
});
