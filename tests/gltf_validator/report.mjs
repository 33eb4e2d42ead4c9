// Print the Khronos validator's report of a .glb file as JSON: report.mjs FOLDER-WITH-NODE_MODULES/ FILE
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";

const [modules, path] = process.argv.slice(2);
const { validateBytes } = createRequire(modules)("gltf-validator");
const report = await validateBytes(new Uint8Array(readFileSync(path)), { maxIssues: 20 });
console.log(JSON.stringify(report));
