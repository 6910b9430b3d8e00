// Bundles the libraries that the console uses into the folder it serves, and writes what they are.
//
// Run by scripts/vendor-console after `npm ci`. The result is committed: nothing is built to run the appliance.
// vendor/manifest.json has, for every file, its SHA-256 and which packages (version, licence) are in it.

import { build } from "esbuild";
import { createHash } from "node:crypto";
import { copyFile, mkdir, readdir, readFile, rm, writeFile } from "node:fs/promises";
import path from "node:path";
import { fileURLToPath } from "node:url";

const HERE = path.dirname(fileURLToPath(import.meta.url));
const OUT = path.resolve(HERE, "../appliance/api/console/vendor");
const FONTS = {
  "inter.woff2": "@fontsource-variable/inter/files/inter-latin-wght-normal.woff2",
  "jetbrains-mono.woff2": "@fontsource-variable/jetbrains-mono/files/jetbrains-mono-latin-wght-normal.woff2",
};

/** The package that a file of node_modules belongs to. */
function packageOf(file) {
  const parts = file.split("node_modules/").at(-1).split("/");
  return parts[0].startsWith("@") ? `${parts[0]}/${parts[1]}` : parts[0];
}

async function described(names) {
  const rows = [];
  for (const name of [...new Set(names)].sort()) {
    const about = JSON.parse(await readFile(path.join(HERE, "node_modules", name, "package.json"), "utf8"));
    rows.push({ name, version: about.version, licence: about.license });
  }
  return rows;
}

async function bundle(entry) {
  const result = await build({
    entryPoints: [path.join(HERE, "entries", entry)],
    outfile: path.join(OUT, entry),
    bundle: true,
    format: "esm",
    target: "es2022",
    minify: true,
    legalComments: "none", // the licences are in LICENCES.txt
    charset: "ascii",
    metafile: true,
  });
  return Object.keys(result.metafile.inputs).filter((one) => one.includes("node_modules/")).map(packageOf);
}

async function licence(name) {
  const folder = path.join(HERE, "node_modules", name);
  const file = (await readdir(folder)).find((one) => /^licen[cs]e/i.test(one));
  return file ? (await readFile(path.join(folder, file), "utf8")).trim() : "(its package has no licence text)";
}

await rm(OUT, { recursive: true, force: true });
await mkdir(OUT, { recursive: true });
const inside = {};
for (const entry of (await readdir(path.join(HERE, "entries"))).sort()) inside[entry] = await bundle(entry);
for (const [file, source] of Object.entries(FONTS)) {
  await copyFile(path.join(HERE, "node_modules", source), path.join(OUT, file));
  inside[file] = [packageOf(`node_modules/${source}`)];
}

const everything = await described(Object.values(inside).flat());
const texts = [];
for (const { name, version, licence: kind } of everything) {
  texts.push(`${name} ${version} (${kind})\n${"=".repeat(60)}\n\n${await licence(name)}\n`);
}
await writeFile(path.join(OUT, "LICENCES.txt"), texts.join("\n\n").replaceAll(/[ \t]+$/gm, ""));
inside["LICENCES.txt"] = [];

const files = {};
for (const file of Object.keys(inside).sort()) {
  const bytes = await readFile(path.join(OUT, file));
  files[file] = {
    sha256: createHash("sha256").update(bytes).digest("hex"),
    bytes: bytes.length,
    packages: await described(inside[file]),
  };
}
await writeFile(path.join(OUT, "manifest.json"), `${JSON.stringify({ files }, null, 2)}\n`);
console.log(Object.entries(files).map(([name, { bytes }]) => `${name}  ${bytes}`).join("\n"));
