// Bundles src/main.ts and its libraries into one script, and copies the style, for gsencoder/infer/page/static.
import { build } from "esbuild";
import { mkdir, readFile, rename, writeFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const target = join(here, "..", "gsencoder", "infer", "page", "static");
const digest = process.argv[2] ?? "unknown";

const result = await build({
  absWorkingDir: here,
  entryPoints: ["src/main.ts"],
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  charset: "ascii",
  legalComments: "none",
  write: false,
  metafile: true,
  logLevel: "warning",
});

// Every package whose code is in the bundle, with its license.
const packages = new Set();
for (const input of Object.keys(result.metafile.inputs)) {
  const match = /(?:^|\/)node_modules\/((?:@[^/]+\/)?[^/]+)\//.exec(input);
  if (match) packages.add(match[1]);
}
// Spark's build has fflate inside.
packages.add("fflate");
const licenses = [];
for (const name of [...packages].sort()) {
  const folder = join(here, "node_modules", name);
  const about = JSON.parse(await readFile(join(folder, "package.json"), "utf8"));
  const text = await readFile(join(folder, "LICENSE"), "utf8");
  licenses.push(`${name} ${about.version} (${about.license})\n\n${text.trim()}\n`);
}
const notice = `Third-party code in this script:\n\n${licenses.join("\n---\n\n")}`;
if (notice.includes("*/")) throw new Error("a license text would end the comment");
const script = result.outputFiles[0].text;
if (/<\/script|<!--/i.test(script)) throw new Error("the script would end the element that it stands in");

await mkdir(target, { recursive: true });
async function put(name, text) {
  const partial = join(target, `.${name}.partial`);
  await writeFile(partial, text);
  await rename(partial, join(target, name));
}
await put("viewer.css", await readFile(join(here, "src", "viewer.css"), "utf8"));
await put("LICENSES.txt", notice);
// The script comes last: where it is, the others are.
await put("viewer.js", `/* sources ${digest} */\n${script}\n/*\n${notice}*/\n`);
