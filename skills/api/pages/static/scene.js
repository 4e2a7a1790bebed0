// A 3-D view, rotated by mouse, touch, keys and buttons. Drawn by plotly; coordinates are mm.
import { say } from "./site.js";

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const LOOKS = {
  home: { eye: { x: -0.72, y: -1.85, z: 0.85 }, up: { x: 0, y: 0, z: 1 } },
  top: { eye: { x: 0, y: 0, z: 2.1 }, up: { x: 0, y: 1, z: 0 } },
  front: { eye: { x: 0, y: -2.1, z: 0 }, up: { x: 0, y: 0, z: 1 } },
  side: { eye: { x: 2.1, y: 0, z: 0 }, up: { x: 0, y: 0, z: 1 } },
};
const TURN = Math.PI / 18;

export const columns = (points) => [0, 1, 2].map((axis) => points.map((point) => point && point[axis]));

export function line(points, { name, width = 4, dash = "solid", ...more }) {
  const [x, y, z] = columns(points);
  return { type: "scatter3d", mode: "lines", x, y, z, name, line: { width, dash, color: colour(more.colour) }, hoverinfo: "name", ...more };
}

export function dots(points, { name, size = 4, symbol = "circle", ...more }) {
  const [x, y, z] = columns(points);
  return {
    type: "scatter3d", mode: "markers", x, y, z, name,
    marker: { size, symbol, color: more.colour && colour(more.colour), ...more.marker },
    hovertemplate: "%{x:.1f}, %{y:.1f}, %{z:.1f} mm<extra>%{fullData.name}</extra>",
    ...Object.fromEntries(Object.entries(more).filter(([key]) => key !== "marker")),
  };
}

// The twelve edges of a grid world, at the outer faces of its cells; `place` moves a corner to the position of the box.
export function box(grid, place = (point) => point) {
  const low = grid.origin_mm.map((o) => o - grid.cell_mm / 2);
  const high = low.map((l, axis) => l + grid.shape[axis] * grid.cell_mm);
  const at = (i) => place([0, 1, 2].map((axis) => ((i >> axis) & 1 ? high[axis] : low[axis])));
  const edges = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
  return edges.flatMap(([a, b]) => [at(a), at(b), null]);
}

export class Scene {
  // `traces` returns new traces at every call, so that they have the colours of the current theme.
  constructor(traces, { frame, picked } = {}) {
    this.place = document.getElementById("view");
    this.traces = traces;
    this.frame = frame;
    this.drawn = this.draw(LOOKS.home).then(() => {
      if (picked) this.place.on("plotly_click", ({ points }) => picked(points[0]));
      this.listen();
      this.place.dataset.drawn = "true";
    });
    this.drawn.catch((failed) => say(this.place, `The view cannot be drawn: ${failed.message}. The numbers below are valid.`));
  }

  draw(camera) {
    const axis = (title) => ({
      title: { text: `${title} (mm)`, font: { size: 12, color: colour("soft") } }, color: colour("soft"), showbackground: false,
      gridcolor: colour("line"), zeroline: false, linecolor: colour("strong"), tickfont: { size: 10 }, showspikes: false, nticks: 7,
    });
    const layout = {
      margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: colour("card"), font: { color: colour("ink"), family: "system-ui, sans-serif" },
      showlegend: false, uirevision: "kept", hoverlabel: { bgcolor: colour("sunk"), font: { color: colour("ink") } },
      scene: { xaxis: axis("x"), yaxis: axis("y"), zaxis: axis("z"), aspectmode: "data", uirevision: "kept", bgcolor: colour("card"),
        ...(camera && { camera: { ...camera, center: { x: 0, y: 0, z: -0.08 } } }) },
    };
    return window.Plotly.react(this.place, this.traces(), layout, { displayModeBar: false, responsive: true, scrollZoom: true });
  }

  redraw() {
    return this.draw(this.camera());
  }

  camera() {
    const { eye, up } = this.place._fullLayout.scene._scene?.getCamera() ?? LOOKS.home;
    return { eye, up };
  }

  look(camera) {
    this.place.dataset.eye = [camera.eye.x, camera.eye.y, camera.eye.z].map((one) => one.toFixed(3)).join(" ");
    return window.Plotly.relayout(this.place, { "scene.camera": { ...camera, center: { x: 0, y: 0, z: -0.08 } } });
  }

  turn(how) {
    const { eye, up } = this.camera();
    const far = Math.hypot(eye.x, eye.y, eye.z);
    let [around, height, distance] = [Math.atan2(eye.y, eye.x), Math.asin(eye.z / far), far];
    if (how === "left") around -= TURN;
    if (how === "right") around += TURN;
    if (how === "up") height = Math.min(height + TURN, 1.5);
    if (how === "down") height = Math.max(height - TURN, -1.5);
    if (how === "near") distance = Math.max(far / 1.2, 0.3);
    if (how === "away") distance = Math.min(far * 1.2, 6);
    const flat = Math.cos(height) * distance;
    const upright = Math.abs(height) < 1.49 ? { x: 0, y: 0, z: 1 } : up;
    this.look({ eye: { x: flat * Math.cos(around), y: flat * Math.sin(around), z: Math.sin(height) * distance }, up: upright });
  }

  listen() {
    const keys = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", "+": "near", "=": "near", "-": "away" };
    this.place.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "0") this.look(LOOKS.home);
      else if (keys[event.key]) this.turn(keys[event.key]);
      else return;
      event.preventDefault();
    });
    this.place.closest(".scene").addEventListener("click", (event) => {
      const { look, turn, save } = event.target.closest("button")?.dataset ?? {};
      if (look) this.look(LOOKS[look]);
      if (turn) this.turn(turn);
      if (save !== undefined) window.Plotly.downloadImage(this.place, { format: "png", width: 1600, height: 1000, filename: "style" });
    });
    document.addEventListener("theme", () => this.redraw());
  }
}

// A list of layers with their markers, to switch them on and off.
export function layerList(place, layers, changed) {
  for (const layer of layers) {
    const item = document.createElement("li");
    item.innerHTML = '<label class="tick"><input type="checkbox"><svg viewBox="0 0 26 16" aria-hidden="true"></svg><span></span></label>';
    const input = item.querySelector("input");
    input.checked = layer.on;
    input.id = `layer-${layer.id}`;
    input.addEventListener("change", () => {
      layer.on = input.checked;
      changed();
    });
    item.querySelector("span").textContent = layer.name;
    mark(item.querySelector("svg"), layer);
    place.append(item);
  }
}

function mark(svg, { shape, colour: name }) {
  const shapes = {
    line: '<path d="M1 12C8 2 18 14 25 4" fill="none" stroke-width="2.2"/>',
    squares: '<path d="M2 8h22" stroke-width="2.2"/><path d="M3 5h6v6h-6zM17 5h6v6h-6z"/>',
    dashes: '<path d="M1 8h24" stroke-width="2.6" stroke-dasharray="6 3"/>',
    circles: '<circle cx="6" cy="8" r="4" fill="none" stroke-width="1.6"/><circle cx="19" cy="8" r="6"/>',
    cells: '<path d="M2 6h4v4h-4zM11 6h4v4h-4zM20 6h4v4h-4z" fill-opacity=".6"/>',
    box: '<path d="M3 13v-9h15v9zM3 4l5-3h15v9l-5 3M18 4l5-3" fill="none" stroke-width="1.2"/>',
    ends: '<path d="M7 3l5 5-5 5-5-5z"/><path d="M19 3v10M14 8h10" stroke-width="2.4"/>',
  };
  svg.innerHTML = shapes[shape];
  const paint = () => {
    svg.setAttribute("stroke", colour(name));
    svg.setAttribute("fill", colour(name));
  };
  paint();
  document.addEventListener("theme", paint);
}

export { colour };
