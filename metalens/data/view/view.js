"use strict";
// Arrays come deflated in base 64; the browser inflates them. Nothing is fetched from anywhere.
const KINDS = { Float32Array, Int32Array, Uint8Array, Uint16Array };
async function unpacked(p) {
  const bytes = Uint8Array.from(atob(p.data), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return { values: new KINDS[p.type](await new Response(stream).arrayBuffer()), shape: p.shape };
}
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const text = (v) => (typeof v === "number" ? (Number.isInteger(v) ? String(v) : Number(v.toPrecision(4)).toString()) : String(v));
function element(tag, parent, attributes = {}, content = "") {
  const e = document.createElement(tag);
  for (const [k, v] of Object.entries(attributes)) e.setAttribute(k, v);
  if (content !== "") e.textContent = content;
  parent?.append(e);
  return e;
}
// cividis in nine steps (perceptually even, for colour-blind readers), and blue-white-red for values with a sign
const CIVIDIS = [[0, 34, 78], [18, 53, 112], [59, 73, 108], [87, 93, 109], [112, 113, 115], [138, 134, 120], [165, 156, 116], [195, 179, 105], [255, 234, 70]];
const SIGNED = [[5, 48, 97], [67, 147, 195], [209, 229, 240], [247, 247, 247], [253, 219, 199], [214, 96, 77], [103, 0, 31]];
function colour(scale, t) {
  const x = Math.max(0, Math.min(1, t)) * (scale.length - 1), i = Math.min(scale.length - 2, Math.floor(x)), f = x - i;
  return scale[i].map((a, k) => a + f * (scale[i + 1][k] - a));
}
const TABLE = (scale) => Array.from({ length: 256 }, (_, i) => colour(scale, i / 255));

function sliders(panel, controls, changed) {
  const at = panel.axes.map((axis) => axis.first);
  panel.axes.forEach((axis, i) => {
    if (axis.values.length < 2) return;
    const label = element("label", controls, {}, axis.name);
    const input = element("input", label, { type: "range", min: 0, max: axis.values.length - 1, value: axis.first, step: 1 });
    const shown = element("output", label);
    const say = () => { const v = `${text(axis.values[at[i]])} ${axis.unit}`; shown.textContent = v; input.setAttribute("aria-valuetext", v); };
    const go = (k) => { at[i] = k; input.value = k; say(); changed(); };
    input.addEventListener("input", () => go(Number(input.value)));
    say();
    if (axis.blink) blinking(controls, () => go((at[i] + 1) % axis.values.length));
  });
  const place = () => at.reduce((sum, k, i) => sum * panel.axes[i].values.length + k, 0);
  // places of the images that blink with this one: they share a scale
  place.others = () => panel.axes.reduce((all, axis, i) => all.flatMap((sum) => (axis.blink ? axis.values.map((_, k) => k) : [at[i]]).map((k) => sum * axis.values.length + k)), [0]);
  return place;
}
function blinking(controls, next) {
  const button = element("button", controls, { type: "button", "aria-pressed": "false" }, "blink");
  let timer = null;
  button.addEventListener("click", () => {
    if (timer) { clearInterval(timer); timer = null; } else timer = setInterval(next, 600);
    button.setAttribute("aria-pressed", timer ? "true" : "false");
  });
}

function tableOf(parent, head, rows, name = "Data") {
  const box = element("details", parent);
  element("summary", box, {}, name);
  let made = false;
  box.addEventListener("toggle", () => { if (box.open && !made) { made = true; fill(element("div", box, { class: "scroll", tabindex: 0 }), head, rows()); } });
  return box;
}
function fill(parent, head, rows) {
  const table = element("table", parent), top = element("tr", element("thead", table)), body = element("tbody", table);
  head.forEach((h) => element("th", top, { scope: "col" }, h));
  rows.slice(0, 2000).forEach((row) => { const tr = element("tr", body); row.forEach((v) => element("td", tr, typeof v === "number" ? { class: "number" } : {}, text(v))); });
  if (rows.length > 2000) element("p", parent, {}, `first 2000 of ${rows.length} rows`);
}

// Labels of an axis with as many digits as tell neighbours apart.
const ticks = (_, splits) => splits.map((v, i) => {
  if (v === null || v === undefined) return "";
  const other = splits[i ? i - 1 : 1] ?? 0, step = Math.abs(v - other) || Math.abs(v) || 1;
  return Number(v.toPrecision(Math.max(1, Math.min(12, 2 + Math.ceil(Math.log10(Math.max(Math.abs(v), step) / step)))))).toString();
});

function axesOf(xName, yName) {
  const ink = { stroke: css("--soft"), grid: { stroke: css("--line"), width: 1 } };
  return [{ label: xName, values: ticks, ...ink }, { label: yName, size: (_, shown) => 36 + 8 * Math.max(3, ...(shown ?? []).map((v) => v.length)), values: ticks, ...ink }];
}

function plot(parent, title, xName, yName, log) {
  let chart = null;
  return (x, lines, bands = []) => {
    const width = Math.max(260, parent.clientWidth), colours = ["--a", "--b", "--c", "--d"].map(css);
    const series = [{ label: xName }], data = [Array.from(x)], shade = [];
    Object.entries(lines).forEach(([name, line], i) => {
      series.push({ label: name, stroke: colours[i % 4], width: 2, points: { show: x.length < 40 } });
      data.push(Array.from(line.y));
      if (line.error) {
        const n = data.length;
        series.push({ label: `${name} + bar`, stroke: "transparent", points: { show: false } }, { label: `${name} - bar`, stroke: "transparent", points: { show: false } });
        data.push(Array.from(line.y, (v, k) => v + line.error[k]), Array.from(line.y, (v, k) => v - line.error[k]));
        shade.push({ series: [n, n + 1], fill: colours[i % 4] + "33" });
      }
    });
    for (let i = 1; i < data.length; i++) data[i] = data[i].map((v) => (Number.isFinite(v) && (!log || v > 0) ? v : null));  // what is no number is a gap
    const drawn = { hooks: { drawAxes: (u) => { u.ctx.save(); u.ctx.fillStyle = css("--b") + "40"; bands.forEach(([a, b]) => { const l = u.valToPos(a, "x", true), r = u.valToPos(b, "x", true); u.ctx.fillRect(l, u.bbox.top, Math.max(1, r - l), u.bbox.height); }); u.ctx.restore(); } } };
    chart?.destroy();
    chart = new uPlot({ width, height: 260, title, series, bands: shade, plugins: [drawn], scales: { x: { time: false }, y: log ? { distr: 3 } : {} }, legend: { show: Object.keys(lines).length > 1 },
      axes: axesOf(xName, yName) }, data, parent);
    chart.root.querySelectorAll(".u-legend .u-series").forEach((row) => { if (/ [+-] bar$/.test(row.querySelector(".u-label")?.textContent.trim() ?? "")) row.style.display = "none"; });
  };
}

// colours with what they mean at both ends; the answer tells (low, high, words behind)
function bar(parent, table) {
  const box = element("p", parent, { class: "bar" }), low = element("span", box), strip = `linear-gradient(to right,${table.filter((_, i) => i % 15 === 0).map((c) => `rgb(${c.map(Math.round).join()})`).join()})`;
  element("span", box, { class: "strip", style: `background:${strip}`, "aria-hidden": "true" });
  const high = element("span", box);
  return (a, b, words) => { low.textContent = text(a); high.textContent = `${text(b)} ${words}`; };
}
async function images(panel, section) {
  const { values, shape } = await unpacked(panel.values), [ny, nx] = shape.slice(-2), size = ny * nx;
  const controls = element("div", section, { class: "controls" }), views = element("div", section, { class: "views" });
  const figure = element("figure", views, { style: "margin:0" });
  const canvas = element("canvas", figure, { class: "image", width: nx, height: ny, tabindex: 0, role: "img", "aria-label": `${panel.title}; arrow keys move the cross` });
  const readout = element("p", section, { class: "readout", "aria-live": "polite" });
  const right = element("div", views, { class: "plot" }), beside = () => element("div", right, { class: "plot" }), profile = plot(beside(), "Along the cross", `x / ${panel.across}`, panel.unit, false);
  const optics = panel.optics ? { mtf: plot(beside(), "MTF", "cycles / mm", "contrast", false), energy: plot(beside(), "Encircled energy", "radius / µm", "share", false) } : null;
  let cross = [Math.floor(ny / 2), Math.floor(nx / 2)], log = false, own = true;
  const table = panel.signed ? TABLE(SIGNED) : TABLE(CIVIDIS), ends = bar(figure, table);
  let all = 0;
  for (const v of values) if (Math.abs(v) > all) all = Math.abs(v);
  const place = sliders(panel, controls, () => draw());
  const tick = (name, start, act) => { const l = element("label", controls, { class: "tick" }), b = element("input", l, { type: "checkbox" }); b.checked = start; l.append(name); b.addEventListener("change", () => { act(b.checked); draw(); }); };
  if (!panel.signed && !panel.from_least) tick("logarithmic", false, (v) => { log = v; });
  tick("own scale", true, (v) => { own = v; });
  const image = () => values.subarray(place() * size, (place() + 1) * size);
  const um = (k, n) => (k - (n - 1) / 2) * panel.step_um;
  function draw() {
    const at = image(), context = canvas.getContext("2d"), out = context.createImageData(nx, ny);
    let top = 0;
    if (own) for (const k of place.others()) for (const v of values.subarray(k * size, (k + 1) * size)) top = Math.max(top, Math.abs(v));
    else top = all;
    top = top || 1;
    const low = panel.from_least ? at.reduce((a, b) => Math.min(a, b), Infinity) : 0, over = top - low || 1;
    for (let i = 0; i < size; i++) {
      let t = panel.signed ? 0.5 + at[i] / top / 2 : (at[i] - low) / over;
      if (log) t = 1 + Math.log10(Math.max(t, 1e-4)) / 4;
      const c = table[Math.max(0, Math.min(255, Math.round(255 * t)))];
      out.data.set([c[0], c[1], c[2], 255], 4 * i);
    }
    stamped(context, out);
    ends(panel.signed ? -top : log ? 1e-4 * top : low, top, `${panel.unit}; ${text(nx * panel.step_um)} × ${text(ny * panel.step_um)} ${panel.across}`);
    context.fillStyle = "#ffffff50";
    context.fillRect(0, cross[0], nx, 0.5); context.fillRect(cross[1], 0, 0.5, ny);
    const x = Array.from({ length: nx }, (_, k) => um(k, nx));
    profile(x, { "along x": { y: at.subarray(cross[0] * nx, (cross[0] + 1) * nx) }, ...(nx === ny ? { "along y": { y: x.map((_, k) => at[k * nx + cross[1]]) } } : {}) });
    readout.textContent = `x ${text(um(cross[1], nx))} ${panel.across}, y ${text(um(cross[0], ny))} ${panel.across}: ${text(at[cross[0] * nx + cross[1]])} ${panel.unit}` + (log ? "; four decades shown" : "");
    if (optics) {
      const t = transfer(at, ny, nx, panel.step_um), e = encircled(at, ny, nx, panel.step_um);
      optics.mtf(t.f, { "along x": { y: t.x }, "along y": { y: t.y } });
      optics.energy(e.r, { share: { y: e.share } });
    }
  }
  const move = (dy, dx) => { cross = [Math.max(0, Math.min(ny - 1, cross[0] + dy)), Math.max(0, Math.min(nx - 1, cross[1] + dx))]; draw(); };
  canvas.addEventListener("click", (event) => { const r = canvas.getBoundingClientRect(); cross = [Math.min(ny - 1, Math.floor((event.clientY - r.top) / r.height * ny)), Math.min(nx - 1, Math.floor((event.clientX - r.left) / r.width * nx))]; draw(); });
  canvas.addEventListener("keydown", (event) => { const step = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key]; if (step) { event.preventDefault(); move(...step); } });
  tableOf(section, [`y / ${panel.across}`, `x / ${panel.across}`, panel.unit || "value"], () => { const at = image(), rows = []; for (let i = 0; i < ny; i += Math.ceil(ny / 40)) for (let k = 0; k < nx; k += Math.ceil(nx / 40)) rows.push([um(i, ny), um(k, nx), at[i * nx + k]]); return rows; }, "Data of this image (every few samples)");
  draw();
  addEventListener("resize", draw);
}
// |Fourier transform| of the sums over one axis: the slice of the transfer function along the other; 1 at zero
function transfer(at, ny, nx, step) {
  const sums = (n, value) => Array.from({ length: n }, (_, k) => value(k));
  const x = sums(nx, (k) => { let s = 0; for (let i = 0; i < ny; i++) s += at[i * nx + k]; return s; });
  const y = sums(ny, (i) => { let s = 0; for (let k = 0; k < nx; k++) s += at[i * nx + k]; return s; });
  const n = 120, upTo = (most) => Array.from({ length: n }, (_, k) => 1e3 * most * k / (n - 1));
  const slice = (line, f) => { const whole = line.reduce((a, b) => a + b, 0) || 1; return f.map((v) => { let re = 0, im = 0; line.forEach((value, k) => { const p = 2 * Math.PI * v * 1e-3 * k * step; re += value * Math.cos(p); im += value * Math.sin(p); }); return Math.hypot(re, im) / whole; }); };
  const whole = upTo(0.5 / step), seen = [slice(x, whole), slice(y, whole)];
  const last = whole.findLastIndex((_, k) => Math.max(seen[0][k], seen[1][k]) > 0.01); // above it nothing is to be seen
  const f = upTo(Math.min(0.5 / step, 1.3e-3 * whole[Math.min(n - 1, last + 1)]));
  return { f, x: slice(x, f), y: slice(y, f) };
}
// share of the light of the window inside circles about its centroid
function encircled(at, ny, nx, step) {
  let whole = 0, cx = 0, cy = 0;
  for (let i = 0; i < ny; i++) for (let k = 0; k < nx; k++) { const v = at[i * nx + k]; whole += v; cx += v * k; cy += v * i; }
  whole = whole || 1; cx /= whole; cy /= whole;
  const n = 80, reach = Math.min(nx, ny) / 2, sums = new Float64Array(n + 1);
  for (let i = 0; i < ny; i++) for (let k = 0; k < nx; k++) { const bin = Math.ceil(Math.hypot(i - cy, k - cx) / reach * n); if (bin <= n) sums[bin] += at[i * nx + k]; }
  for (let i = 1; i <= n; i++) sums[i] += sums[i - 1];
  return { r: Array.from(sums, (_, i) => i * reach * step / n), share: Array.from(sums, (v) => v / whole) };
}

async function curves(panel, section) {
  const x = (await unpacked(panel.x)).values, lines = {}, errors = {};
  for (const [name, p] of Object.entries(panel.lines)) lines[name] = (await unpacked(p)).values;
  for (const [name, p] of Object.entries(panel.errors)) errors[name] = (await unpacked(p)).values;
  const controls = element("div", section, { class: "controls" }), box = element("div", section, { class: "plot" });
  const show = plot(box, "", panel.x_name, panel.y_name, panel.scale === "log"), n = x.length;
  const place = sliders(panel, controls, () => draw());
  const slice = (a) => a.subarray(place() * n, (place() + 1) * n);
  const now = () => Object.fromEntries(Object.entries(lines).map(([name, y]) => [name, { y: slice(y), error: errors[name] && slice(errors[name]) }]));
  const draw = () => show(x, now(), panel.bands);
  tableOf(section, [panel.x_name, ...Object.keys(lines).flatMap((name) => (errors[name] ? [name, `error bar of ${name}`] : [name]))], () => {
    const at = now();
    return Array.from(x, (v, i) => [v, ...Object.values(at).flatMap((l) => (l.error ? [l.y[i], l.error[i]] : [l.y[i]]))]);
  });
  draw();
  addEventListener("resize", draw);
}

// Points to pick: a click takes the nearest, arrow keys step through them by rising x.
async function points(panel, section) {
  const { x, y, groups, front, notes } = panel, order = x.map((_, i) => i).sort((a, b) => x[a] - x[b] || y[a] - y[b]), kinds = [...new Set(groups)];
  const box = element("div", section, { class: "plot pick", tabindex: 0, role: "group", "aria-label": `${panel.title}; arrow keys step through the points` });
  const readout = element("p", section, { class: "readout", "aria-live": "polite" });
  let chart = null, at = front.length ? front[front.length - 1] : order[0];
  const noted = (i) => Object.entries(notes[i] ?? {}).map(([name, v]) => `, ${name} ${text(v)}`).join("");
  const pick = (i) => { at = i; readout.textContent = `${groups[i]}${front.includes(i) ? ` (in the ${panel.front_name})` : ""}: ${panel.x_name} ${text(x[i])}, ${panel.y_name} ${text(y[i])}${noted(i)}`; chart.redraw(); };
  const place = (u, i) => [u.valToPos(x[i], "x", true), u.valToPos(y[i], "y", true)];
  const ring = { hooks: { draw: (u) => { const c = u.ctx, r = devicePixelRatio || 1; c.save(); c.strokeStyle = css("--ink"); c.lineWidth = 2 * r; c.beginPath(); c.arc(...place(u, at), 9 * r, 0, 7); c.stroke(); c.restore(); } } };
  const joined = uPlot.paths.stepped({ align: 1 }), none = () => null;
  function draw() {
    const colours = ["--a", "--b", "--c", "--d"].map(css), held = new Set(front);
    const series = [{ label: panel.x_name }, ...kinds.map((name, i) => ({ label: name, paths: none, stroke: colours[i % 4], points: { show: true, size: 8, fill: colours[i % 4] } }))], data = [order.map((i) => x[i]), ...kinds.map((name) => order.map((i) => (groups[i] === name ? y[i] : null)))];
    if (front.length) { series.push({ label: panel.front_name, paths: joined, stroke: css("--ink"), width: 1.5, spanGaps: true, points: { show: false } }); data.push(order.map((i) => (held.has(i) ? y[i] : null))); }
    chart?.destroy();
    const reach = (all) => { const low = Math.min(...all), high = Math.max(...all), more = 0.06 * (high - low || Math.abs(high) || 1); return () => [low - more, high + more]; };
    chart = new uPlot({ width: Math.max(260, box.clientWidth), height: 320, series, plugins: [ring], scales: { x: { time: false, range: reach(x) }, y: { range: reach(y) } }, axes: axesOf(panel.x_name, panel.y_name), cursor: { drag: { x: false, y: false } }, legend: { live: false } }, data, box);
    pick(at);
  }
  box.addEventListener("click", (e) => { // before the chart, which keeps clicks to itself where the pointer has moved
    if (e.target !== chart.over) return;
    const r = chart.over.getBoundingClientRect(), far = (i) => Math.hypot(chart.valToPos(x[i], "x") - (e.clientX - r.left), chart.valToPos(y[i], "y") - (e.clientY - r.top));
    pick(order.reduce((a, b) => (far(b) < far(a) ? b : a)));
  }, true);
  box.addEventListener("keydown", (e) => { const step = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[e.key]; if (step) { e.preventDefault(); pick(order[Math.max(0, Math.min(order.length - 1, order.indexOf(at) + step))]); } });
  const names = [...new Set(notes.flatMap((note) => Object.keys(note)))];
  tableOf(section, ["", panel.x_name, panel.y_name, panel.front_name, ...names], () => order.map((i) => [groups[i], x[i], y[i], front.includes(i) ? "yes" : "", ...names.map((name) => notes[i]?.[name] ?? "")]));
  draw();
  addEventListener("resize", draw);
}

// Every site of a map: sums and counts over 2, 4, 8 ... sites, so that far away the mean of a screen pixel is drawn. Each
// level is the one before under the weights 1 3 3 1 along both axes, which leave less of fine zones than equal ones do.
function pyramid(index, sizes, ny, nx) {
  const levels = [];
  let sum = new Float32Array(ny * nx), count = new Float32Array(ny * nx), h = ny, w = nx;
  for (let i = 0; i < index.length; i++) if (index[i]) { sum[i] = sizes[index[i] - 1]; count[i] = 1; }
  while (h > 1 && w > 1) {
    const H = Math.ceil(h / 2), W = Math.ceil(w / 2);
    [sum, count] = [halved(sum, h, w), halved(count, h, w)];
    [h, w] = [H, W];
    levels.push({ sum, count, h, w, sites: 2 ** (levels.length + 1) });
  }
  return levels;
}
function halved(from, h, w) {
  const H = Math.ceil(h / 2), W = Math.ceil(w / 2), half = new Float32Array(h * W), out = new Float32Array(H * W);
  for (let i = 0; i < h; i++) for (let k = 0; k < W; k++) {
    const at = i * w + 2 * k;
    half[i * W + k] = 0.375 * (from[at] + (2 * k + 1 < w ? from[at + 1] : 0)) + 0.125 * ((k ? from[at - 1] : 0) + (2 * k + 2 < w ? from[at + 2] : 0));
  }
  for (let i = 0; i < H; i++) for (let k = 0; k < W; k++) {
    const at = 2 * i * W + k;
    out[i * W + k] = 0.375 * (half[at] + (2 * i + 1 < h ? half[at + W] : 0)) + 0.125 * ((i ? half[at - W] : 0) + (2 * i + 2 < h ? half[at + 2 * W] : 0));
  }
  return out;
}
// Pixels as a picture that is drawn: what is put into a canvas while a page is printed does not reach the paper.
function stamped(c, pixels) {
  const held = new OffscreenCanvas(pixels.width, pixels.height);
  held.getContext("2d").putImageData(pixels, 0, 0);
  c.drawImage(held, 0, 0);
}
// A plane to move about on: drag, wheel, keys, buttons. box: {w, h} of the whole in its own lengths, y down, from 0.
// paint(c, view) draws what view = {scale, cx, cy, W, H} shows (scale: pixels a length); tell(x, y, scale) says what lies there.
function board(panel, section, box, um, closeup, paint, tell) {
  const controls = element("div", section, { class: "controls" });
  const canvas = element("canvas", section, { class: "map", tabindex: 0, role: "img", "aria-label": `${panel.title}; arrow keys move, plus and minus zoom, 0 shows all` });
  const readout = element("p", section, { class: "readout", "aria-live": "polite" });
  const view = { scale: 1, cx: box.w / 2, cy: box.h / 2, W: 1, H: 1 };
  let fit = 1, queued = false;
  function sized() {
    const ratio = devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio; canvas.height = canvas.clientHeight * ratio;
    view.W = canvas.width; view.H = canvas.height;
    fit = Math.min(view.W / box.w, view.H / box.h) * 0.98;
  }
  const whole = () => { sized(); Object.assign(view, { scale: fit, cx: box.w / 2, cy: box.h / 2 }); later(); };
  function draw() {
    queued = false;
    const c = canvas.getContext("2d");
    c.fillStyle = "#fff"; c.fillRect(0, 0, view.W, view.H);
    paint(c, view);
    const wanted = 120 / view.scale * um, power = 10 ** Math.floor(Math.log10(wanted)), length = [5, 2, 1].map((m) => m * power).find((v) => v <= wanted) || power, px = length / um * view.scale;
    c.fillStyle = "#fff"; c.fillRect(8, view.H - 44, px + 16, 36); c.fillStyle = "#111"; c.fillRect(16, view.H - 18, px, 4);
    c.font = `${13 * (devicePixelRatio || 1)}px system-ui`; c.fillText(`${text(length)} µm`, 16, view.H - 24);
  }
  const later = () => { if (!queued) { queued = true; requestAnimationFrame(draw); } };
  const zoom = (factor) => { view.scale = Math.max(fit / 2, Math.min(6 * closeup, view.scale * factor)); later(); };
  let drag = null;
  canvas.addEventListener("pointerdown", (e) => { drag = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => { drag = null; });
  canvas.addEventListener("pointermove", (e) => {
    const r = canvas.getBoundingClientRect(), ratio = canvas.width / r.width;
    if (drag) { view.cx -= (e.clientX - drag[0]) * ratio / view.scale; view.cy -= (e.clientY - drag[1]) * ratio / view.scale; drag = [e.clientX, e.clientY]; later(); }
    readout.textContent = tell(view.cx + ((e.clientX - r.left) * ratio - view.W / 2) / view.scale, view.cy + ((e.clientY - r.top) * ratio - view.H / 2) / view.scale, view.scale);
  });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(2 ** (-e.deltaY / 300)); }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const step = view.W / 8 / view.scale, move = { ArrowUp: [0, -step], ArrowDown: [0, step], ArrowLeft: [-step, 0], ArrowRight: [step, 0] }[e.key];
    if (move) { view.cx += move[0]; view.cy += move[1]; later(); } else if (e.key === "+") zoom(1.5); else if (e.key === "-") zoom(1 / 1.5); else if (e.key === "0") whole(); else return;
    readout.textContent = tell(view.cx, view.cy, view.scale);
    e.preventDefault();
  });
  for (const [name, act] of [["zoom in", () => zoom(2)], ["zoom out", () => zoom(0.5)], ["whole", whole], ["one pillar", () => { view.scale = closeup; later(); }]]) element("button", controls, { type: "button" }, name).addEventListener("click", act);
  addEventListener("resize", () => { const keep = view.scale / fit; sized(); view.scale = keep * fit; draw(); }); // at once: paper waits for no frame
  whole();
  return { controls, later };
}
function markers(c, marks, place) {
  c.strokeStyle = "#c0392b"; c.lineWidth = 2;
  for (const [x, y] of marks) { const [px, py] = place(x, y); c.strokeRect(px - 5, py - 5, 10, 10); }
}
async function classes(panel, section) {
  const { values: index, shape: [ny, nx] } = await unpacked(panel.index), sizes = panel.sizes;
  const levels = pyramid(index, sizes, ny, nx), table = TABLE(CIVIDIS);
  let low = Infinity, high = -Infinity;
  for (const v of sizes) { low = Math.min(low, v); high = Math.max(high, v); }
  const shade = (v) => table[Math.max(0, Math.min(255, Math.round(255 * (v - low) / (high - low || 1))))];
  function paint(c, v) {
    (v.scale >= 6 ? near : far)(c, v);
    markers(c, panel.marks, (x, y) => [(x / panel.pitch_um + nx / 2 - v.cx) * v.scale + v.W / 2, (y / panel.pitch_um + ny / 2 - v.cy) * v.scale + v.H / 2]);
  }
  function near(c, { scale, cx, cy, W, H }) {
    const i0 = Math.max(0, Math.floor(cy - H / 2 / scale)), i1 = Math.min(ny, Math.ceil(cy + H / 2 / scale)), k0 = Math.max(0, Math.floor(cx - W / 2 / scale)), k1 = Math.min(nx, Math.ceil(cx + W / 2 / scale));
    for (let i = i0; i < i1; i++) for (let k = k0; k < k1; k++) {
      const one = index[i * nx + k];
      if (!one) continue;
      const v = sizes[one - 1], radius = v * (panel.unit === "nm" ? 1e-3 : 1) / panel.pitch_um / 2 * scale;
      c.fillStyle = `rgb(${shade(v).map(Math.round).join()})`;
      c.beginPath(); c.arc((k + 0.5 - cx) * scale + W / 2, (i + 0.5 - cy) * scale + H / 2, radius, 0, 7); c.fill();
    }
  }
  // far away: between the four nearest of a level whose sites are a pixel or more, so that nothing is passed over
  function far(c, { scale, cx, cy, W, H }) {
    const level = scale >= 1 || !levels.length ? null : levels[Math.min(levels.length - 1, Math.max(0, Math.ceil(Math.log2(1 / scale) - 1e-9) - 1))];
    const out = c.createImageData(W, H), held = new Float64Array(2);
    for (let y = 0; y < H; y++) for (let x = 0; x < W; x++) {
      (level ? between : single)(level, cx + (x + 0.5 - W / 2) / scale, cy + (y + 0.5 - H / 2) / scale, held);
      if (!(held[1] > 0)) continue;
      const rgb = shade(held[0] / held[1]), part = Math.min(1, held[1]), to = 4 * (y * W + x);
      for (let n = 0; n < 3; n++) out.data[to + n] = 255 + part * (rgb[n] - 255);
      out.data[to + 3] = 255;
    }
    stamped(c, out);
  }
  function single(_, atX, atY, held) {
    const k = Math.floor(atX), i = Math.floor(atY), one = i >= 0 && k >= 0 && i < ny && k < nx ? index[i * nx + k] : 0;
    held[0] = one ? sizes[one - 1] : 0; held[1] = one ? 1 : 0;
  }
  function between({ sum, count, h, w, sites }, atX, atY, held) {
    const fx = atX / sites - 0.5, fy = atY / sites - 0.5, k = Math.floor(fx), i = Math.floor(fy);
    held[0] = held[1] = 0;
    for (let r = Math.max(0, i); r < Math.min(h, i + 2); r++) for (let q = Math.max(0, k); q < Math.min(w, k + 2); q++) {
      const part = (1 - Math.abs(fy - r)) * (1 - Math.abs(fx - q)), at = r * w + q;
      held[0] += part * sum[at]; held[1] += part * count[at];
    }
  }
  function tell(atX, atY, scale) {
    const k = Math.floor(atX), i = Math.floor(atY);
    if (i < 0 || k < 0 || i >= ny || k >= nx) return "";
    const one = index[i * nx + k], x = (k - (nx - 1) / 2) * panel.pitch_um, y = (i - (ny - 1) / 2) * panel.pitch_um;
    const more = one ? Object.entries(panel.columns).map(([name, column]) => `, ${name} ${text(column[one - 1])}`).join("") : "";
    const mark = panel.marks.find(([mx, my]) => Math.hypot(mx - x, my - y) < Math.max(panel.pitch_um, 6 / scale * panel.pitch_um));
    return `row ${i}, column ${k} (x ${text(x)}, y ${text(y)} µm): ` + (one ? `${text(sizes[one - 1])} ${panel.unit}${more}` : "nothing here") + (mark ? `. ${mark[2]}` : "");
  }
  board(panel, section, { w: nx, h: ny }, panel.pitch_um, 80, paint, tell);
  bar(section, table)(low, high, panel.unit);
  tableOf(section, [`size / ${panel.unit}`, "sites", ...Object.keys(panel.columns)], () => { const n = new Float64Array(sizes.length + 1); for (const v of index) n[v]++; return sizes.map((v, i) => [v, n[i + 1], ...Object.values(panel.columns).map((c) => c[i])]).filter((row) => row[1]); }, "Sizes and how many sites have them");
}

// Places of each outline by rising y; its own box and area, so that far away it adds its area to a pixel.
async function placed(outline) {
  const corners = (await unpacked(outline.corners)).values, x = (await unpacked(outline.dx)).values, y = (await unpacked(outline.dy)).values;
  for (let i = 1; i < x.length; i++) { x[i] += x[i - 1]; y[i] += y[i - 1]; }
  const own = { left: Infinity, right: -Infinity, low: Infinity, high: -Infinity };
  let area = 0;
  for (let i = 0, n = corners.length; i < n; i += 2) {
    own.left = Math.min(own.left, corners[i]); own.right = Math.max(own.right, corners[i]); own.low = Math.min(own.low, corners[i + 1]); own.high = Math.max(own.high, corners[i + 1]);
    area += (corners[i] * corners[(i + 3) % n] - corners[(i + 2) % n] * corners[i + 1]) / 2;
  }
  let left = Infinity, right = -Infinity;
  for (const v of x) { if (v < left) left = v; if (v > right) right = v; }
  return { ...outline, corners, x, y, own, area: Math.abs(area), box: { left: left + own.left, right: right + own.right, low: y[0] + own.low, high: y[y.length - 1] + own.high } };
}
function firstAbove(sorted, value) {
  let a = 0, b = sorted.length;
  while (a < b) { const m = (a + b) >> 1; if (sorted[m] < value) a = m + 1; else b = m; }
  return a;
}
async function drawing(panel, section) {
  const outlines = (await Promise.all(panel.outlines.map(placed))).sort((a, b) => b.area - a.area), hidden = new Set();
  const names = [...new Set(outlines.map((o) => o.layer))].sort((a, b) => a.localeCompare(b, undefined, { numeric: true }));
  const palette = names.map((_, i) => (names.length < 2 ? [0, 34, 78] : colour(CIVIDIS, (0.86 * i) / (names.length - 1)).map(Math.round)));
  const left = Math.min(...outlines.map((o) => o.box.left)), top = Math.max(...outlines.map((o) => o.box.high));
  const box = { w: Math.max(...outlines.map((o) => o.box.right)) - left, h: top - Math.min(...outlines.map((o) => o.box.low)) };
  const shown = () => outlines.filter((o) => !hidden.has(o.layer));
  function paint(c, v) {
    const cover = new Float32Array(v.W * v.H * 4);
    for (const o of shown()) {
      const size = Math.max(o.own.right - o.own.left, o.own.high - o.own.low) * v.scale;
      if (size < 2) spread(o, v, cover, palette[names.indexOf(o.layer)]);
    }
    blend(c, v, cover);
    for (const o of shown()) if (Math.max(o.own.right - o.own.left, o.own.high - o.own.low) * v.scale >= 2) outlined(c, o, v, palette[names.indexOf(o.layer)]);
    markers(c, panel.marks, (x, y) => [(x / panel.unit_um - left - v.cx) * v.scale + v.W / 2, (top - y / panel.unit_um - v.cy) * v.scale + v.H / 2]);
  }
  const inView = (o, v) => {
    const high = top - (v.cy - v.H / 2 / v.scale), low = top - (v.cy + v.H / 2 / v.scale);
    return [firstAbove(o.y, low - o.own.high), firstAbove(o.y, high - o.own.low)];
  };
  function spread(o, v, cover, rgb) {
    const [a, b] = inView(o, v), share = o.area * v.scale * v.scale, mx = (o.own.left + o.own.right) / 2, my = (o.own.low + o.own.high) / 2;
    for (let i = a; i < b; i++) { // shared among four pixels, so that a lattice gives no beat with theirs
      const fx = (o.x[i] + mx - left - v.cx) * v.scale + v.W / 2 - 0.5, fy = (top - o.y[i] - my - v.cy) * v.scale + v.H / 2 - 0.5, px = Math.floor(fx), py = Math.floor(fy);
      if (px < 0 || py < 0 || px >= v.W - 1 || py >= v.H - 1) continue;
      const ux = fx - px, uy = fy - py;
      for (const [step, part] of [[0, (1 - ux) * (1 - uy)], [1, ux * (1 - uy)], [v.W, (1 - ux) * uy], [v.W + 1, ux * uy]]) {
        const at = 4 * (py * v.W + px + step), one = share * part;
        cover[at] += one * rgb[0]; cover[at + 1] += one * rgb[1]; cover[at + 2] += one * rgb[2]; cover[at + 3] += one;
      }
    }
  }
  function blend(c, v, cover) {
    const out = c.createImageData(v.W, v.H);
    for (let i = 0; i < cover.length; i += 4) {
      const share = cover[i + 3], part = Math.min(1, share);
      for (let k = 0; k < 3; k++) out.data[i + k] = share ? 255 + part * (cover[i + k] / share - 255) : 255;
      out.data[i + 3] = 255;
    }
    stamped(c, out);
  }
  function outlined(c, o, v, rgb) {
    const [a, b] = inView(o, v), lo = v.cx - v.W / 2 / v.scale + left - o.own.right, hi = v.cx + v.W / 2 / v.scale + left - o.own.left;
    c.fillStyle = `rgba(${rgb.join()},${o.area > box.w * box.h / 50 ? 0.06 : 0.75})`; c.strokeStyle = `rgb(${rgb.join()})`; c.lineWidth = 1;
    for (let i = a; i < b; i++) {
      if (o.x[i] < lo || o.x[i] > hi) continue;
      c.beginPath();
      for (let k = 0; k < o.corners.length; k += 2) c.lineTo((o.x[i] + o.corners[k] - left - v.cx) * v.scale + v.W / 2, (top - o.y[i] - o.corners[k + 1] - v.cy) * v.scale + v.H / 2);
      c.closePath(); c.fill(); c.stroke();
    }
  }
  const inside = (p, x, y) => {
    let odd = false;
    for (let i = 0, j = p.length - 2; i < p.length; j = i, i += 2) if (p[i + 1] > y !== p[j + 1] > y && x < ((p[j] - p[i]) * (y - p[i + 1])) / (p[j + 1] - p[i + 1]) + p[i]) odd = !odd;
    return odd;
  };
  function tell(atX, atY, scale) {
    const x = atX + left, y = top - atY, found = [];
    for (const o of shown()) for (let i = firstAbove(o.y, y - o.own.high); i < o.y.length && o.y[i] <= y - o.own.low; i++) {
      if (x < o.x[i] + o.own.left || x > o.x[i] + o.own.right || !inside(o.corners, x - o.x[i], y - o.y[i])) continue;
      found.push(`${o.layer}, ${Object.entries(o.notes).map(([name, v]) => `${name} ${text(v)}`).join(", ")}`);
      break;
    }
    const mark = panel.marks.find(([mx, my]) => Math.hypot(mx / panel.unit_um - x, my / panel.unit_um - y) < 8 / scale);
    return `x ${(x * panel.unit_um).toFixed(3)}, y ${(y * panel.unit_um).toFixed(3)} µm: ` + (found.slice(0, 3).join("; ") || "nothing here") + (mark ? `. ${mark[2]}` : "");
  }
  const small = Math.min(...outlines.map((o) => Math.max(o.own.right - o.own.left, o.own.high - o.own.low)));
  const { controls, later } = board(panel, section, box, panel.unit_um, 40 / small, paint, tell);
  names.forEach((name) => {
    const label = element("label", controls, { class: "tick" }), tick = element("input", label, { type: "checkbox" });
    tick.checked = true;
    element("span", label, {}, name);
    tick.addEventListener("change", () => { if (tick.checked) hidden.delete(name); else hidden.add(name); later(); });
  });
  tableOf(section, ["layer", "copies", "area / µm²", ...new Set(outlines.flatMap((o) => Object.keys(o.notes)))], () => {
    const notes = [...new Set(outlines.flatMap((o) => Object.keys(o.notes)))];
    return outlines.map((o) => [o.layer, o.x.length, o.area * panel.unit_um ** 2, ...notes.map((name) => o.notes[name] ?? "")]);
  }, "Shapes and how many copies they have");
}

const DRAW = { ImagePanel: images, CurvePanel: curves, ClassMapPanel: classes, DrawingPanel: drawing, PointPanel: points, TablePanel: async (panel, section) => fill(element("div", section, { class: panel.rows.length > 40 ? "scroll" : "scroll whole", tabindex: 0 }), panel.head, panel.rows) };
(async () => {
  const data = JSON.parse(document.getElementById("data").textContent), main = document.getElementById("panels"), status = document.getElementById("status");
  for (const panel of data.panels) {
    const section = element("section", main, { "aria-label": panel.title });
    element("h2", section, {}, panel.title);
    try { await DRAW[panel.type](panel, section); } catch (error) { element("p", section, { class: "failed" }, `cannot be shown: ${error.message}`); }
    if (panel.caption) element("figcaption", section, {}, panel.caption);
  }
  const about = document.getElementById("about");
  for (const [name, value] of Object.entries(data.about)) { element("dt", about, {}, name); element("dd", about, {}, typeof value === "object" ? Object.entries(value).map(([k, v]) => `${k}: ${v}`).join("\n") : String(value)); }
  // on paper everything is as wide as the sheet: figures are drawn anew for it, and for the screen again afterwards
  for (const [when, on] of [["beforeprint", true], ["afterprint", false]]) addEventListener(when, () => { document.body.classList.toggle("paper", on); dispatchEvent(new Event("resize")); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => dispatchEvent(new Event("resize")));
  const tables = data.panels.filter((panel) => panel.type === "TablePanel").length, drawn = data.panels.length - tables, of = (n, what) => (n ? [`${n} ${what}${n > 1 ? "s" : ""}`] : []);
  status.textContent = [...of(drawn, "figure"), ...of(tables, "table")].join(", ");
  document.body.dataset.ready = "true";
})();
