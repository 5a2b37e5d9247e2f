// Bundles the service's page (hashed files and index.html, in service/web/dist) and what report.html inlines (one
// script and one style sheet, in biresnerf/viewer/dist). hatch_build.py runs it.
import { build } from "esbuild";
import { createHash } from "node:crypto";
import { existsSync, mkdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { basename, dirname, join } from "node:path";
import { brotliCompressSync, constants, gzipSync } from "node:zlib";

const PAGE = "service/web";
const VIEWER = "biresnerf/viewer";
// Smaller ones fit in one packet anyway.
const COMPRESSED_FROM_BYTES = 1000;

const shared = {
  bundle: true,
  minify: true,
  charset: "utf8",
  target: ["es2022", "chrome109", "firefox115", "safari16.4"],
  jsx: "automatic",
  jsxImportSource: "preact",
  legalComments: "none",
  metafile: true,
  write: false,
  logLevel: "warning",
};

async function buildPage() {
  const dist = fresh(`${PAGE}/dist`);
  const result = await build({
    ...shared,
    entryPoints: { app: `${PAGE}/app.tsx`, style: `${PAGE}/styles/style.css` },
    outdir: dist,
    entryNames: "[name]-[hash]",
    chunkNames: "[name]-[hash]",
    format: "esm",
    splitting: true,
  });
  const named = {};
  for (const file of result.outputFiles) {
    const name = basename(file.path);
    named[name.replace(/-[A-Z0-9]+\.(\w+)$/, ".$1")] = name;
    put(dist, name, file.contents);
  }
  const icon = readFileSync(`${PAGE}/icon.svg`);
  named["icon.svg"] = `icon-${createHash("sha256").update(icon).digest("hex").slice(0, 8).toUpperCase()}.svg`;
  put(dist, named["icon.svg"], icon);
  const html = readFileSync(`${PAGE}/index.html`, "utf8").replace(/\{([\w.]+)\}/g, (_, name) => {
    if (!(name in named)) throw new Error(`index.html names ${name}, which the build did not make`);
    return `web/${named[name]}`;
  });
  put(dist, "index.html", Buffer.from(html));
  put(dist, "licences.txt", licencesOf(result.metafile));
}

async function buildReport() {
  const dist = fresh(`${VIEWER}/dist`);
  const result = await build({
    ...shared,
    entryPoints: { report: `${VIEWER}/report.tsx`, style: `${VIEWER}/report.css` },
    outdir: dist,
    format: "iife",
  });
  for (const file of result.outputFiles) {
    writeFileSync(join(dist, basename(file.path).replace("style.css", "report.css")), file.contents);
  }
  writeFileSync(join(dist, "licences.txt"), licencesOf(result.metafile));
}

function fresh(folder) {
  rmSync(folder, { recursive: true, force: true });
  mkdirSync(folder, { recursive: true });
  return folder;
}

// The file, and beside it what is sent to browsers that take it compressed.
function put(folder, name, contents) {
  writeFileSync(join(folder, name), contents);
  if (contents.length < COMPRESSED_FROM_BYTES) return;
  writeFileSync(join(folder, `${name}.gz`), gzipSync(contents, { level: 9 }));
  writeFileSync(
    join(folder, `${name}.br`),
    brotliCompressSync(contents, { params: { [constants.BROTLI_PARAM_QUALITY]: 11 } }),
  );
}

// The licences of the libraries whose code is in the bundle, as they ask for.
function licencesOf(metafile) {
  const folders = new Set();
  for (const input of Object.keys(metafile.inputs)) {
    const found = /^(.*node_modules\/(?:@[^/]+\/)?[^/]+)\//.exec(input);
    if (found) folders.add(found[1]);
  }
  const texts = [...folders].sort().map((folder) => {
    const { name, version } = JSON.parse(readFileSync(join(folder, "package.json"), "utf8"));
    const file = ["LICENSE", "LICENSE.md", "LICENCE", "LICENSE.txt"].map((n) => join(folder, n)).find(existsSync);
    if (!file) throw new Error(`${dirname(folder)}: ${name} comes without a licence`);
    return `${name} ${version}\n\n${readFileSync(file, "utf8").trim()}\n`;
  });
  return Buffer.from(texts.join(`\n${"-".repeat(80)}\n\n`));
}

await buildPage();
if (existsSync(`${VIEWER}/report.tsx`)) await buildReport();
