// A bag folder as one file: its recordings and the files that describe them in a zip without compression, as the
// command packs it. Pictures and anything else stay on the disk.
import { say } from "./site.js";

const KEPT = /\.(mcap|mcap\.zstd|db3|bag|ya?ml|jsonl?|parquet|csv|txt)$/i;
const MOST_BYTES = 2 ** 32 - 2 ** 24; // of a zip in the form that is read
const FLAGS = 0x0800; // names are UTF-8
const DATE = 33; // 1980-01-01, so that equal folders give equal bytes

const TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let k = 0; k < 8; k += 1) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1;
  return n;
});

async function crcOf(file) {
  let crc = 0xffffffff;
  const reader = file.stream().getReader();
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    const bytes = part.value;
    for (let i = 0; i < bytes.length; i += 1) crc = TABLE[(crc ^ bytes[i]) & 0xff] ^ (crc >>> 8);
  }
  return (crc ^ 0xffffffff) >>> 0;
}

// Write numbers of 2 or 4 bytes one after the other: pairs of a number and its width.
function record(...fields) {
  const made = new DataView(new ArrayBuffer(fields.reduce((sum, [, width]) => sum + width, 0)));
  let at = 0;
  for (const [value, width] of fields) {
    if (width === 4) made.setUint32(at, value, true);
    else made.setUint16(at, value, true);
    at += width;
  }
  return made.buffer;
}

// Pack pairs of a path and a file.
async function pack(found, name) {
  const kept = found.filter(([path]) => KEPT.test(path) && !path.split("/").some((part) => part.startsWith(".")));
  kept.sort(([a], [b]) => (a < b ? -1 : 1));
  if (!kept.length) throw new Error(`There is no recording in ${name}; choose the folder of a bag, with its .mcap or .db3.`);
  if (kept.reduce((sum, [, file]) => sum + file.size, 0) > MOST_BYTES) throw new Error(`${name} is over 4 GiB; choose one bag, or cut it.`);
  const [parts, list] = [[], []];
  let at = 0;
  for (const [path, file] of kept) {
    const text = new TextEncoder().encode(path);
    const about = [[20, 2], [FLAGS, 2], [0, 2], [0, 2], [DATE, 2], [await crcOf(file), 4], [file.size, 4], [file.size, 4], [text.length, 2], [0, 2]];
    const head = record([0x04034b50, 4], ...about);
    parts.push(head, text, file);
    list.push(record([0x02014b50, 4], [20, 2], ...about, [0, 2], [0, 2], [0, 2], [0, 4], [at, 4]), text);
    at += head.byteLength + text.length + file.size;
  }
  const size = list.reduce((sum, one) => sum + (one.byteLength ?? one.length), 0);
  const end = record([0x06054b50, 4], [0, 2], [0, 2], [kept.length, 2], [kept.length, 2], [size, 4], [at, 4], [0, 2]);
  return new File([...parts, ...list, end], `${name}.zip`, { type: "application/zip" });
}

async function below(entry, path = entry.name) {
  if (entry.isFile) return [[path, await new Promise((resolve, reject) => entry.file(resolve, reject))]];
  const reader = entry.createReader();
  const found = [];
  for (;;) {
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) return found; // it lists a hundred at a time
    for (const one of some) found.push(...(await below(one, `${path}/${one.name}`)));
  }
}

async function give(input, packing) {
  say(input, "");
  try {
    const held = new DataTransfer();
    held.items.add(await packing());
    input.files = held.files;
  } catch (problem) {
    say(input, problem.message);
  }
  input.dispatchEvent(new Event("change", { bubbles: true }));
}

// Take files or a folder that are dropped on an element, and folders of another input, into a file input.
export function takeFolders(drop, input, folder) {
  for (const name of ["dragover", "dragleave", "drop"]) {
    drop.addEventListener(name, (event) => {
      event.preventDefault();
      drop.classList.toggle("over", name === "dragover");
      if (name !== "drop" || !event.dataTransfer.files.length) return;
      const entry = [...event.dataTransfer.items].map((one) => one.webkitGetAsEntry?.()).find((one) => one?.isDirectory);
      if (entry) return give(input, async () => pack(await below(entry), entry.name));
      input.files = event.dataTransfer.files;
      input.dispatchEvent(new Event("change", { bubbles: true }));
    });
  }
  folder.addEventListener("change", () => {
    const found = [...folder.files].map((file) => [file.webkitRelativePath || file.name, file]);
    if (found.length) give(input, () => pack(found, found[0][0].split("/")[0]));
  });
}
