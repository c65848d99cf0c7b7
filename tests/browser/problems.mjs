// Prints the problems of a page: problems.mjs PAGE
import { accessibilityFindings, open, report } from "./browser.mjs";

await report({}, async (browser) => {
  const { page, problems } = await open(browser, process.argv[2]);
  return [...problems, ...(await accessibilityFindings(page))];
});
