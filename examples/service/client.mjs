// SPDX-License-Identifier: Apache-2.0
// A client of `pcgraph serve`: the boxes of the objects of a file.
// Usage: node client.mjs FILE [ADDRESS]
import { readFile } from "node:fs/promises";
import { basename } from "node:path";

const [path, address = "http://127.0.0.1:8000"] = process.argv.slice(2);
const query = new URLSearchParams({ name: basename(path), wait: 60 });
const made = await (await fetch(`${address}/segmentations?${query}`, { method: "POST", body: await readFile(path) })).json();
const { boxes } = await (await fetch(address + made.links.boxes)).json();
for (const box of boxes) console.log(box.segment, ...box.size);
