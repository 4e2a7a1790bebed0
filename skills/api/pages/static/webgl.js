// Drawing with WebGL 2: lines of any width, marks, and capsules. What is drawn are plain objects, as `scene.js` makes them.

const PROGRAMS = {
  // A segment is four corners, as wide in pixels on the screen wherever it is. They are not instances of one: a renderer
  // without a graphics card draws instances one after another, which took four times as long.
  line: {
    vertex: `uniform mat4 seen; uniform vec2 window; uniform float width;
      in vec3 a, b; in float begins, corner; out float side; out float along;
      void main() {
        side = along = 0.0;
        if (begins < 0.0) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }  // a gap
        vec4 p = seen * vec4(a, 1.0), q = seen * vec4(b, 1.0);
        float near = 0.01;
        if (p.w < near && q.w > near) p = mix(p, q, (near - p.w) / (q.w - p.w));
        else if (q.w < near && p.w > near) q = mix(q, p, (near - q.w) / (p.w - q.w));
        vec2 way = (q.xy / q.w - p.xy / p.w) * window;
        vec2 ahead = length(way) > 1e-5 ? normalize(way) : vec2(1.0, 0.0);
        bool last = corner > 1.5;
        float half_px = width / 2.0 + 0.5;
        side = mod(corner, 2.0) > 0.5 ? half_px : -half_px;
        along = begins + (last ? distance(a, b) : 0.0);
        vec4 here = last ? q : p;
        vec2 off = vec2(-ahead.y, ahead.x) * side + ahead * (last ? 0.25 : -0.25) * width;
        gl_Position = here + vec4(off / window * here.w, 0.0, 0.0);
      }`,
    fragment: `uniform vec4 colour; uniform float width; uniform vec3 dash; in float side; in float along;
      void main() {
        float place = mod(along, dash.x + dash.y);
        if (dash.z > 0.0 && place > dash.x) discard;
        float cover = clamp(width / 2.0 + 0.5 - abs(side), 0.0, 1.0);
        if (cover < 0.05) discard;
        shown = vec4(colour.rgb, colour.a * cover);
      }`,
  },
  dots: {
    vertex: `uniform mat4 seen; uniform float ratio; in vec3 at; in vec4 paint; in float size; out vec4 tint; out float px;
      void main() { gl_Position = seen * vec4(at, 1.0); px = size * ratio + 2.0; gl_PointSize = px; tint = paint; }`,
    fragment: `uniform int symbol; in vec4 tint; in float px;
      void main() {
        vec2 p = abs(gl_PointCoord - 0.5) * px;  // pixels from the middle
        float reach = px / 2.0 - 1.0, far;
        if (symbol == 1) far = max(p.x, p.y) - reach * 0.85;
        else if (symbol == 2) far = (p.x + p.y - reach) * 0.7;
        else if (symbol == 3) far = abs(p.x + p.y - reach * 0.85) * 0.7 - max(1.0, reach * 0.16);
        else if (symbol == 4) far = max(min(p.x, p.y) - reach * 0.3, max(p.x, p.y) - reach);
        else if (symbol == 5) far = max(abs(p.x - p.y) * 0.7 - reach * 0.25, max(p.x, p.y) - reach * 0.8);
        else far = length(p) - reach;
        float cover = clamp(0.5 - far, 0.0, 1.0);
        if (cover < 0.05) discard;
        shown = vec4(tint.rgb, tint.a * cover);
      }`,
  },
  // One capsule of unit radius, stretched between two ends.
  bodies: {
    vertex: `uniform mat4 seen; uniform vec3 light; in vec4 shape; in vec3 begin, end; in float radius; in vec4 paint; out vec4 tint;
      void main() {
        vec3 axis = end - begin;
        float len = length(axis);
        vec3 z = len > 1e-6 ? axis / len : vec3(0.0, 0.0, 1.0);
        vec3 x = normalize(cross(abs(z.z) < 0.9 ? vec3(0.0, 0.0, 1.0) : vec3(1.0, 0.0, 0.0), z));
        vec3 outwards = x * shape.x + cross(z, x) * shape.y + z * shape.z;
        gl_Position = seen * vec4(mix(begin, end, shape.w) + radius * outwards, 1.0);
        tint = vec4(paint.rgb * (0.62 + 0.38 * max(0.0, dot(outwards, light))), paint.a);
      }`,
    fragment: "in vec4 tint; void main() { shown = tint; }",
  },
};
const SYMBOLS = ["circle", "square", "diamond", "diamond-open", "cross", "x"];
// Lengths of a dash and of the gap after it, in pixels.
const DASHES = { dash: [9, 6], longdash: [16, 7], dot: [2.5, 4], dashdot: [12, 5] };
const ROUND = 14, RINGS = 4;

function capsule() {
  const [places, corners] = [[], []];
  for (let ring = 0; ring <= 2 * RINGS + 1; ring += 1) {
    const last = ring > RINGS;
    const height = ((ring - (last ? RINGS + 1 : RINGS)) / RINGS) * (Math.PI / 2);
    for (let turn = 0; turn < ROUND; turn += 1) {
      const around = (2 * Math.PI * turn) / ROUND;
      places.push(Math.cos(height) * Math.cos(around), Math.cos(height) * Math.sin(around), Math.sin(height), last ? 1 : 0);
      if (ring === 2 * RINGS + 1) continue;
      const [here, beside] = [ring * ROUND + turn, ring * ROUND + ((turn + 1) % ROUND)];
      corners.push(here, beside, here + ROUND, beside, beside + ROUND, here + ROUND);
    }
  }
  return [new Float32Array(places), new Uint16Array(corners)];
}

export class Renderer {
  // `rgb` turns the name of a colour, or a colour, into three numbers from 0 to 1.
  constructor(canvas, rgb) {
    this.canvas = canvas;
    this.rgb = rgb;
    // Without a graphics card smooth edges cost half of the frames; lines and marks are smooth anyway.
    this.gl = canvas.getContext("webgl2", { failIfMajorPerformanceCaveat: true }) ?? canvas.getContext("webgl2", { antialias: false });
    if (!this.gl) throw new Error("this browser has no WebGL 2");
    const { gl } = this;
    this.programs = Object.fromEntries(Object.entries(PROGRAMS).map(([name, of]) => [name, this.program(of)]));
    this.buffers = new Map();
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    [this.places, this.corners] = [gl.createBuffer(), gl.createBuffer()];
    const [places, corners] = capsule();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.places);
    gl.bufferData(gl.ARRAY_BUFFER, places, gl.STATIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    this.count = corners.length;
  }

  program({ vertex, fragment }) {
    const { gl } = this;
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, `out vec4 shown;\n${fragment}`]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, `#version 300 es\nprecision highp float;\n${text}`);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) ?? "the graphics context is lost");
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    const uniforms = {}, inputs = {};
    for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i += 1) {
      const { name } = gl.getActiveUniform(made, i);
      uniforms[name] = gl.getUniformLocation(made, name);
    }
    for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_ATTRIBUTES); i += 1) {
      const { name } = gl.getActiveAttrib(made, i);
      if (!name.startsWith("gl_")) inputs[name] = gl.getAttribLocation(made, name);
    }
    return { made, uniforms, inputs };
  }

  // Things keep their buffers as long as they are drawn; `changed` of a thing says that its numbers are new.
  buffer(thing, numbers) {
    const { gl } = this;
    let kept = this.buffers.get(thing);
    if (!kept) this.buffers.set(thing, (kept = { buffer: gl.createBuffer(), values: null }));
    gl.bindBuffer(gl.ARRAY_BUFFER, kept.buffer);
    if (!kept.values || thing.changed) {
      kept.values = numbers();
      gl.bufferData(gl.ARRAY_BUFFER, kept.values, thing.changed ? gl.DYNAMIC_DRAW : gl.STATIC_DRAW);
      thing.changed = false;
    }
    return kept.values.length;
  }

  // Columns of the bound buffer as inputs of a program: name and width, in order.
  inputs({ inputs }, columns, divisor) {
    const { gl } = this;
    const stride = 4 * columns.reduce((sum, [, width]) => sum + width, 0);
    let offset = 0;
    for (const [name, width] of columns) {
      gl.enableVertexAttribArray(inputs[name]);
      gl.vertexAttribPointer(inputs[name], width, gl.FLOAT, false, stride, offset);
      gl.vertexAttribDivisor(inputs[name], divisor);
      offset += 4 * width;
    }
    return stride / 4;
  }

  use(name) {
    const { gl } = this;
    const program = this.programs[name];
    for (let i = 0; i < 8; i += 1) gl.disableVertexAttribArray(i);
    gl.useProgram(program.made);
    gl.uniformMatrix4fv(program.uniforms.seen, false, this.seen);
    return program;
  }

  // Draw things as seen by a matrix; `light` is the direction to the light, `ratio` the pixels of the screen per CSS pixel.
  draw(things, seen, light, ratio) {
    const { gl } = this;
    this.seen = seen;
    this.light = light;
    this.ratio = ratio;
    for (const [thing, { buffer }] of this.buffers) {
      if (things.includes(thing)) continue;
      gl.deleteBuffer(buffer);
      this.buffers.delete(thing);
    }
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    for (const kind of ["bodies", "line", "dots"]) {
      const mine = things.filter((thing) => thing.kind === kind);
      for (const clear of [false, true]) {
        const some = mine.filter((thing) => (thing.opacity ?? 1) < 1 === clear);
        if (!some.length) continue;
        if (clear || kind !== "bodies") gl.enable(gl.BLEND);
        else gl.disable(gl.BLEND);
        gl.depthMask(!clear);
        const program = this.use(kind);
        some.forEach((thing) => this[kind](thing, program));
      }
    }
    gl.depthMask(true);
  }

  line(thing, program) {
    const { gl, ratio } = this;
    const { uniforms } = program;
    this.buffer(thing, () => segments(thing.points));
    const [dash, gap] = DASHES[thing.dash] ?? [1, 0];
    const size = thing.mmPerPx ?? 1;
    gl.uniform2f(uniforms.window, this.canvas.width / 2, this.canvas.height / 2);
    gl.uniform1f(uniforms.width, thing.width * ratio);
    gl.uniform4f(uniforms.colour, ...this.rgb(thing.colour), thing.opacity ?? 1);
    gl.uniform3f(uniforms.dash, dash * size, gap * size, gap);
    this.inputs(program, [["a", 3], ["b", 3], ["begins", 1], ["corner", 1]], 0);
    const all = this.buffers.get(thing).values.length / 32;
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.squares(all));
    gl.drawElements(gl.TRIANGLES, 6 * Math.min(all, thing.shown ?? all), gl.UNSIGNED_INT, 0);
  }

  // The corners of two triangles for each of at least so many squares.
  squares(count) {
    const { gl } = this;
    if (count <= (this.many ?? 0)) return this.pairs;
    this.many = 2 * count;
    this.pairs ??= gl.createBuffer();
    const corners = new Uint32Array(6 * this.many);
    for (let i = 0; i < corners.length; i += 1) corners[i] = 4 * Math.floor(i / 6) + [0, 1, 2, 1, 3, 2][i % 6];
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.pairs);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    return this.pairs;
  }

  dots(thing, program) {
    const { gl } = this;
    const columns = this.buffer(thing, () => marks(thing, this.rgb));
    gl.uniform1i(program.uniforms.symbol, Math.max(0, SYMBOLS.indexOf(thing.symbol)));
    gl.uniform1f(program.uniforms.ratio, this.ratio);
    this.inputs(program, [["at", 3], ["paint", 4], ["size", 1]], 0);
    gl.drawArrays(gl.POINTS, 0, columns / 8);
  }

  bodies(thing, program) {
    const { gl } = this;
    const columns = this.buffer(thing, () => thing.segments);
    gl.uniform3f(program.uniforms.light, ...this.light);
    const width = this.inputs(program, [["begin", 3], ["end", 3], ["radius", 1]], 1);
    gl.disableVertexAttribArray(program.inputs.paint);
    gl.vertexAttrib4f(program.inputs.paint, ...this.rgb(thing.colour), thing.opacity ?? 1);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.places);
    this.inputs(program, [["shape", 4]], 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.corners);
    gl.drawElementsInstanced(gl.TRIANGLES, this.count, gl.UNSIGNED_SHORT, 0, columns / width);
  }
}

// The segments between points (x, y, z, x, ...), with a row of eight numbers for each of four corners: both ends, the length
// of the line before it, -1 at a gap, which is NaN, and the number of the corner.
function segments(points) {
  const count = Math.max(0, points.length / 3 - 1);
  const found = new Float32Array(32 * count);
  let along = 0;
  for (let i = 0; i < count; i += 1) {
    const far = Math.hypot(points[3 * i + 3] - points[3 * i], points[3 * i + 4] - points[3 * i + 1], points[3 * i + 5] - points[3 * i + 2]);
    const gap = !Number.isFinite(far);
    for (let corner = 0; corner < 4; corner += 1) {
      const at = 32 * i + 8 * corner;
      if (!gap) found.set(points.subarray(3 * i, 3 * i + 6), at);
      found[at + 6] = gap ? -1 : along;
      found[at + 7] = corner;
    }
    along = gap ? 0 : along + far;
  }
  return found;
}

function marks({ points, size, colours, colour, opacity = 1 }, rgb) {
  const count = points.length / 3;
  const found = new Float32Array(8 * count);
  const one = colours ? null : rgb(colour);
  for (let i = 0; i < count; i += 1) {
    found.set(points.subarray(3 * i, 3 * i + 3), 8 * i);
    found.set(one ?? colours[i], 8 * i + 3);
    found[8 * i + 6] = opacity;
    found[8 * i + 7] = 2 * (Array.isArray(size) ? size[i] : size);
  }
  return found;
}
