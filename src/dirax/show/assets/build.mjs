// Bundles src/ with three.js and uPlot into report.js, and says in report.json what it was made of.

import { createHash } from "node:crypto";
import { readFileSync, readdirSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const read = (name) => readFileSync(new URL(name, import.meta.url), "utf8");
const version = (name) => JSON.parse(read(`node_modules/${name}/package.json`)).version;
const digest = (text) => createHash("sha256").update(text).digest("hex");

const packages = Object.fromEntries(["three", "uplot"].map((name) => [name, version(name)]));
const licences = Object.keys(packages).map((name) => `${name} ${packages[name]}\n\n${read(`node_modules/${name}/LICENSE`)}`);
const style = read("node_modules/uplot/dist/uPlot.min.css").trim();
const { outputFiles } = await build({
  entryPoints: [new URL("src/main.js", import.meta.url).pathname],
  bundle: true,
  minify: true,
  write: false,
  format: "iife",
  target: "es2021",
  legalComments: "none",
  banner: { js: `/* dirax report, Apache-2.0; with three.js ${packages.three} and uPlot ${packages.uplot}, MIT: LICENSES.txt beside it */` },
});
const [{ text }] = outputFiles;
const sources = Object.fromEntries(
  ["build.mjs", "package.json", ...readdirSync(new URL("src", import.meta.url)).sort().map((name) => `src/${name}`)].map((name) => [name, digest(read(name))]),
);
writeFileSync(new URL("report.js", import.meta.url), text);
writeFileSync(new URL("uplot.css", import.meta.url), `${style}\n`);
writeFileSync(new URL("LICENSES.txt", import.meta.url), licences.join("\n\n"));
const made = { packages, sources, made: { "report.js": digest(text), "uplot.css": digest(`${style}\n`) } };
writeFileSync(new URL("report.json", import.meta.url), `${JSON.stringify(made, null, 2)}\n`);
console.log(`report.js: ${Math.round(text.length / 1000)} kB, three ${packages.three}, uplot ${packages.uplot}`);
