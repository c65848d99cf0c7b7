// Opens pages from disk in headless Chromium; called by the scripts that tests/common/browser.rs runs.
//
// scripts/setup-browser.sh installs the npm packages in target/browser. Console errors and network requests are
// collected as `problems`.
import { createRequire } from "node:module";
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const packages = createRequire(`${process.env.NERF_SR_BROWSER}/`);
const { chromium } = packages("playwright-core");

const QUIET = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
  "--disable-component-update", "--disable-sync"];
const SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];

/** Starts Chromium; `webgl` enables WebGL2 by a software renderer. */
export async function start({ webgl = false } = {}) {
  return chromium.launch({
    executablePath: process.env.NERF_SR_CHROMIUM,
    args: [...QUIET, ...(webgl ? SOFTWARE_GL : ["--disable-gpu"])],
  });
}

/** Opens the file at `path`; returns its `page` and `problems`, a list that errors and requests are added to. */
export async function open(browser, path, { width = 1440, height = 900, dark = false } = {}) {
  const context = await browser.newContext({
    viewport: { width, height },
    colorScheme: dark ? "dark" : "light",
    reducedMotion: "reduce",
    hasTouch: width < 600,
  });
  // Pages of several megabytes load slowly on a busy machine.
  context.setDefaultTimeout(180_000);
  const page = await context.newPage();
  const problems = [];
  page.on("console", (message) => {
    if (["error", "warning"].includes(message.type())) problems.push(`console: ${message.text()}`);
  });
  page.on("pageerror", (error) => problems.push(`error: ${error.message}`));
  page.on("request", (request) => {
    if (!/^(file|data|blob):/.test(request.url())) problems.push(`request: ${request.url()}`);
  });
  await page.goto(pathToFileURL(path).href);
  return { page, problems };
}

/**
 * Returns the serious and critical findings of axe-core, one line each. Checks only the first six and last six stages and
 * rows of a table: a hundred take more than a minute.
 */
export async function accessibilityFindings(page) {
  await page.evaluate(readFileSync(packages.resolve("axe-core/axe.min.js"), "utf8"));
  const { violations } = await page.evaluate(() => {
    const tables = [...document.querySelectorAll("tbody")].map((body) => [...body.rows]);
    const exclude = [[...document.querySelectorAll("details.stage")], ...tables].flatMap((all) => all.slice(6, -6));
    return window.axe.run({ exclude });
  });
  return violations
    .filter(({ impact }) => ["serious", "critical"].includes(impact))
    .map(({ id, help, nodes }) => `${id}: ${help}: ${nodes.slice(0, 3).map(({ target }) => target.join(" ")).join(", ")}`);
}

/** Runs `check`, prints its result as JSON, and closes the browser, also after an error. */
export async function report(options, check) {
  const browser = await start(options);
  try {
    console.log(JSON.stringify(await check(browser)));
  } finally {
    await browser.close();
  }
}
