// What was understood of a recording, drawn as tables from the answer of POST /recordings/preview.
import { element, percent, rowOf } from "./site.js";

const number = (value, unit, digits = 1) => (value === null ? "–" : `${Number(value.toFixed(digits))} ${unit}`);
const counted = (count, one, many = `${one}s`) => `${count.toLocaleString("en")} ${count === 1 ? one : many}`;
const INTEGRITY = { full: "checksums cover everything", partial: "checksums cover a part", none: "no checksums" };
const MOST_PROPOSED = 20;

function table(heads, rows, caption) {
  const made = element("table", { className: "stack" }, ...(caption ? [element("caption", {}, caption)] : []));
  made.append(
    element("thead", {}, element("tr", {}, ...heads.map((head) => element("th", { scope: "col" }, head)))),
    element("tbody", {}, ...rows.map(([first, ...others]) => {
      const row = element("tr", {}, element("th", { scope: "row" }, first));
      others.forEach((text, k) => {
        const cell = element("td", {}, text);
        cell.dataset.name = heads[k + 1];
        row.append(cell);
      });
      return row;
    })),
  );
  return element("div", { className: "scroll" }, made);
}

function facts(seen) {
  const rows = [
    ["Format", seen.format, INTEGRITY[seen.integrity]],
    ["Duration", number(seen.duration_s, "s", 2), seen.timed ? "" : "it has no times"],
    ...seen.motions.filter((one) => one.duplicate_stamps).map((one) => ["Repeated stamps", counted(one.duplicate_stamps, "sample"), `dropped of ${one.topic}`]),
    ...seen.dropped.map((one) => ["Stamps that went back", counted(one.backward_stamps, "sample"), `dropped of ${one.topic}`]),
    ...Object.entries(seen.tools).map(([arm, tool]) => [`Instrument of ${arm}`, tool, "as stated"]),
    ...seen.left_out.map((one) => ["Left out", one.topic, one.because]),
  ];
  return element("table", {}, element("tbody", {}, ...rows.map((row) => rowOf(...row))));
}

function motions(seen) {
  const rows = seen.motions.map((one, k) => {
    const quality = seen.quality[k];
    const equal = quality.equal_samples ? `${quality.equal_samples} (${percent(quality.equal_samples / one.samples)})` : "none";
    return [one.arm, one.topic, one.frame, one.samples.toLocaleString("en"), number(quality.rate_hz, "Hz"), quality.extent_mm.map((side) => side.toFixed(1)).join(", ") + " mm", equal];
  });
  return table(["Arm", "Topic", "Frame", "Samples", "Rate", "Extent x, y, z", "Repeat a pose"], rows, "Motions");
}

function instrument({ instrument: name, generation, candidates }) {
  if (!name) return "–";
  return `${generation}, ${name}${candidates.length > 1 ? `, or one of ${candidates.length - 1} of equal lengths` : ""}`;
}

function identified(seen) {
  if (!seen.identifications.length) return element("p", { className: "small" }, "No joints beside poses, so arm and instrument cannot be identified.");
  const rows = seen.identifications.map(({ arm, topic, found }) => [
    arm, topic, found.verdict, instrument(found), `${found.residual_mm.toFixed(3)}\u00a0mm`, found.reason,
  ]);
  return table(["Arm", "Topic", "Verdict", "Arm and instrument", "Residual", "Reason"], rows, "Identification, from joints beside poses");
}

function columns(seen) {
  if (!seen.columns.length) return [];
  const used = seen.columns.filter((one) => one.quantity).length;
  const rows = seen.columns.map((one) => [one.name, one.quantity || "not used", one.unit || "–"]);
  const details = element("details", { open: rows.length <= 12 }, element("summary", {}, `Columns: ${used} of ${rows.length} are used`));
  details.append(table(["Column", "Read as", "Unit"], rows, ""));
  return [details];
}

function proposals(seen) {
  const count = seen.counts.segments;
  const words = seen.timed ? `${counted(count, "hand-off is", "hand-offs are")} proposed.` : "Hand-offs are proposed once the samples have times.";
  const list = element("ol", {}, ...seen.segments.slice(0, MOST_PROPOSED).map((one) => element("li", {}, `${one.arm}, ${one.start_s.toFixed(1)} to ${one.end_s.toFixed(1)} s: ${one.reason}.`)));
  const more = count > MOST_PROPOSED ? [element("p", { className: "small" }, `And ${count - MOST_PROPOSED} more.`)] : [];
  return [element("h3", {}, "Proposals"), element("p", {}, words), ...(count ? [list] : []), ...more];
}

export const understood = (seen) => [facts(seen), motions(seen), identified(seen), ...columns(seen), ...proposals(seen)];
