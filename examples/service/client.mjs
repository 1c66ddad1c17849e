// SPDX-License-Identifier: Apache-2.0
// A client of `pcgraph serve`: the boxes of the objects of a file.
// Usage: [PCGRAPH_TOKEN=...] node client.mjs FILE [ADDRESS]
import { readFile } from "node:fs/promises";
import { basename } from "node:path";

const [path, address = "http://127.0.0.1:8000"] = process.argv.slice(2);
const token = process.env.PCGRAPH_TOKEN;
const headers = token ? { Authorization: `Bearer ${token}` } : {};

async function answer(link, options = {}) {
  const response = await fetch(address + link, { headers, ...options });
  const content = await response.json();
  if (!response.ok) throw new Error(`${response.status}: ${content.detail}`);
  return content;
}

const query = new URLSearchParams({ name: basename(path), wait: 60 });
const made = await answer(`/segmentations?${query}`, { method: "POST", body: await readFile(path) });
const { boxes } = await answer(made.links.boxes);
for (const box of boxes) console.log(box.segment, ...box.size);
