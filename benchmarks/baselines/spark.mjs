// node spark.mjs IN.ply COUNT OUT.ply [BASE]: build a level-of-detail tree as Spark's `build-lod --bhatt-lod=BASE`
// does, with the WebAssembly of the package @sparkjsdev/spark (on NODE_PATH), and write its cut of COUNT Gaussians.
import { readFileSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { dirname, join } from "node:path";

const [source, budget, output, base = "1.1"] = process.argv.slice(2);
let folder;
try {
  folder = dirname(createRequire(import.meta.url).resolve("@sparkjsdev/spark"));
} catch {
  console.error("@sparkjsdev/spark: not on NODE_PATH (npm i -g @sparkjsdev/spark; export NODE_PATH=$(npm root -g))");
  process.exit(1);
}
if (source === "--version") {
  console.log(`Spark ${JSON.parse(readFileSync(join(folder, "../package.json"))).version}`);
  process.exit(0);
}

// The package's module holds its worker and its WebAssembly as strings.
const text = readFileSync(join(folder, "spark.module.js"), "utf8");
const wasm = new WebAssembly.Module(Buffer.from(/decode64\("([^"]+)"\)/.exec(text)[1], "base64"));
const worker = new Function(`return ${/const jsContent = ('.*');$/m.exec(text)[1]}`)();

// Call the worker's loader in this process.
function loaded(args) {
  return new Promise((resolve, reject) => {
    let listener;
    const self = {
      addEventListener: (_, added) => {
        listener = added;
        if (added.name === "onMessage") added({ data: { id: 0, name: "loadExtSplats", args } });
      },
      removeEventListener: () => {},
      postMessage: ({ result, error }) => (error ? reject(error) : result && resolve(result.lodSplats)),
    };
    new Function("self", "console", worker)(self, { ...console, log: () => {} });
    listener({ data: { name: "init-wasm", module: wasm } });
  });
}

function half(bits) {
  const [exponent, fraction] = [(bits >> 10) & 31, bits & 1023];
  const size = exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -24 * fraction;
  return bits & 0x8000 ? -size : size;
}

// Expand the largest node first, by the size that the renderer compares with pixels, up to the budget.
function cut(tree, count) {
  const size = (node) => half(tree[4 * node + 1] >>> 16);
  const heap = [0];
  const leaves = [];
  const pop = () => {
    const top = heap[0];
    const last = heap.pop();
    for (let at = 0; heap.length; ) {
      let child = 2 * at + 1;
      if (child + 1 < heap.length && size(heap[child + 1]) > size(heap[child])) child += 1;
      if (child >= heap.length || size(heap[child]) <= size(last)) {
        heap[at] = last;
        break;
      }
      heap[at] = heap[child];
      at = child;
    }
    return top;
  };
  const push = (node) => {
    let at = heap.length;
    for (; at && size(heap[(at - 1) >> 1]) < size(node); at = (at - 1) >> 1) heap[at] = heap[(at - 1) >> 1];
    heap[at] = node;
  };
  while (heap.length) {
    const node = pop();
    const [children, first] = [tree[4 * node + 2] & 0xffff, tree[4 * node + 3]];
    if (!children || heap.length + leaves.length + children > count) leaves.push(node);
    else for (let child = first; child < first + children; child++) push(child);
  }
  return leaves;
}

function quaternion(bits) {
  let [x, y] = [(bits & 1023) / 511.5 - 1, ((bits >>> 10) & 1023) / 511.5 - 1];
  const z = 1 - Math.abs(x) - Math.abs(y);
  const fold = Math.max(-z, 0);
  [x, y] = [x - Math.sign(x) * fold, y - Math.sign(y) * fold];
  const angle = ((bits >>> 20) / 4095) * (Math.PI / 2);
  const scale = Math.sin(angle) / Math.hypot(x, y, z);
  return [Math.cos(angle), x * scale, y * scale, z * scale];
}

function colour(bits) {
  const unit = 2 ** ((bits >>> 27) - 15) / 255;
  return [0, 1, 2].map((i) => ((bits >>> (8 * i)) & 255) * unit * (bits & (1 << (24 + i)) ? -1 : 1));
}

const { extArrays, extra } = await loaded({
  fileBytes: readFileSync(source), fileType: "ply", pathName: source, lod: "quality", lodBase: Number(base),
});
const kept = cut(extra.lodTree, Number(budget));
// Words of the higher bands: 3 coefficients of degree 1, 5 of degree 2 (the first in sh1's last word), 7 of degree 3.
const words = extra.sh1 ? [[extra.sh1, extra.sh2 ? 4 : 3]] : [];
if (extra.sh2) words.push([extra.sh2, 4]);
if (extra.sh3a) words.push([extra.sh3a, 4], [extra.sh3b, 3]);
const rest = words.reduce((sum, [, taken]) => sum + taken, 0);
const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"];
for (let i = 0; i < 3 * rest; i++) names.push(`f_rest_${i}`);
names.push("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3");
const rows = new Float32Array(names.length * kept.length);
const [first, second] = extArrays;
const place = new Float32Array(first.buffer, first.byteOffset, first.length);
kept.forEach((node, row) => {
  const at = 4 * node;
  const low = (word) => half(word & 0xffff);
  const rgb = [low(second[at]), half(second[at] >>> 16), low(second[at + 1])];
  const scales = [half(second[at + 1] >>> 16), low(second[at + 2]), half(second[at + 2] >>> 16)];
  let [opacity, grown] = [low(first[at + 3]), 0];
  if (opacity > 1) {
    // A node of several layers: opaque, and larger by the cube root of their opacity, as `--inflate` writes it.
    grown = (Math.min(4 * opacity - 3, 5) ** 2 - 1) / Math.E / 3;
    opacity = 1;
  }
  const alpha = Math.min(Math.max(opacity, 1e-6), 1 - 1e-6);
  const harmonics = words.flatMap(([array, taken]) => [...array.subarray(at, at + taken)].map(colour));
  rows.set([
    ...place.subarray(at, at + 3),
    ...rgb.map((value) => (value - 0.5) / 0.28209479177387814),
    ...[0, 1, 2].flatMap((channel) => harmonics.map((value) => value[channel])),
    Math.log(alpha / (1 - alpha)),
    ...scales.map((value) => value + grown),
    ...quaternion(second[at + 3]),
  ], row * names.length);
});
const header = ["ply", "format binary_little_endian 1.0", `element vertex ${kept.length}`,
  ...names.map((name) => `property float ${name}`), "end_header", ""].join("\n");
writeFileSync(output, Buffer.concat([Buffer.from(header), Buffer.from(rows.buffer)]));
