// Reads a pack as the page does and writes its arrays one after the other: node read_pack.mjs PACK OUT NAME...

import { readFileSync, writeFileSync } from "node:fs";
import { readPack } from "../../src/echospline/page/static/scene.js";

const [path, out, ...names] = process.argv.slice(2);
const pack = readPack(new Uint8Array(readFileSync(path)));
const bytes = names.map((name) => pack.array(name)).map((values) => new Uint8Array(values.buffer, values.byteOffset, values.byteLength));
writeFileSync(out, Buffer.concat(bytes));
