// Copies what the pages load into ../assets/vendor: KaTeX with its fonts, and the worker of the search for pages without a server.

import { cpSync, mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";

const here = (name) => new URL(name, import.meta.url);
const read = (name) => readFileSync(here(name), "utf8");
const version = (name) => JSON.parse(read(`node_modules/${name}/package.json`)).version;
const target = "../assets/vendor";

rmSync(here(target), { recursive: true, force: true });
mkdirSync(here(`${target}/fonts`), { recursive: true });
const style = read("node_modules/katex/dist/katex.min.css").replace(/,url\([^)]*\.(?:woff|ttf)\) format\("[^"]*"\)/g, "");
writeFileSync(here(`${target}/katex.min.css`), style);
cpSync(here("node_modules/katex/dist/katex.min.js"), here(`${target}/katex.min.js`));
cpSync(here("node_modules/iframe-worker/shim/index.js"), here(`${target}/iframe-worker.js`));
for (const font of readdirSync(here("node_modules/katex/dist/fonts"))) {
  if (font.endsWith(".woff2")) cpSync(here(`node_modules/katex/dist/fonts/${font}`), here(`${target}/fonts/${font}`));
}
const packages = ["katex", "iframe-worker"];
const licences = packages.map((name) => `${name} ${version(name)}\n\n${read(`node_modules/${name}/LICENSE`)}`);
writeFileSync(here(`${target}/LICENSES.txt`), licences.join("\n\n"));
console.log(packages.map((name) => `${name} ${version(name)}`).join(", "));
