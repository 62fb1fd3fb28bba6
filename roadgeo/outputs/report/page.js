"use strict";
// Zoom, pan and layers of every figure.viewer, and the place under the pointer and the match that all of them show.

const ZOOM = 1.5; // of a button or key
const PAN = 0.15; // of a key, shares of the width
const DEEPEST = 4000; // zoom against the first view
const REACH = 18; // pixels between a click and the match that it means

class Viewer {
  constructor(figure) {
    this.figure = figure;
    this.stage = figure.querySelector(".stage");
    this.svg = figure.querySelector("svg.view");
    this.frame = this.svg.dataset.frame;
    const [x, y, width, height] = this.svg.getAttribute("viewBox").split(" ").map(Number);
    this.home = { x: x + width / 2, y: y + height / 2, width, height };
    this.pointers = new Map();
    this.fitted = true;
    this.listen();
    new ResizeObserver(() => this.resize()).observe(this.stage);
  }

  // --- the view: center (x, y) and units per pixel (u)

  resize() {
    this.width = this.stage.clientWidth;
    this.height = this.stage.clientHeight;
    if (this.fitted || !this.u) this.fit();
    else this.apply();
  }

  fit() {
    this.fitted = true;
    this.x = this.home.x;
    this.y = this.home.y;
    this.u = Math.max(this.home.width / this.width, this.home.height / this.height);
    this.least = this.u / DEEPEST;
    this.most = this.u * 3;
    this.apply();
  }

  zoom(factor, at = { x: this.x, y: this.y }) {
    const u = Math.min(Math.max(this.u / factor, this.least), this.most);
    const kept = u / this.u;
    this.move(at.x + (this.x - at.x) * kept, at.y + (this.y - at.y) * kept, u);
  }

  move(x, y, u = this.u) {
    this.fitted = false;
    const { home } = this;
    this.x = Math.min(Math.max(x, home.x - home.width), home.x + home.width);
    this.y = Math.min(Math.max(y, home.y - home.height), home.y + home.height);
    this.u = u;
    this.apply();
  }

  show(point, span) {
    const u = span ? span / Math.min(this.width, this.height) : this.u;
    const away = Math.max(Math.abs(point.x - this.x) / this.width, Math.abs(point.y - this.y) / this.height);
    if (span || away > 0.45 * this.u) this.move(point.x, point.y, Math.max(u, this.least));
  }

  apply() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = 0;
      const { svg, u } = this;
      const [width, height] = [this.width * u, this.height * u];
      const box = [this.x - width / 2, this.y - height / 2, width, height];
      svg.setAttribute("viewBox", box.map((value) => value.toPrecision(9)).join(" "));
      svg.style.setProperty("--u", u);
      if (svg.dataset.arrows) this.exaggerate(Math.max(1, svg.dataset.arrows * u));
      if (this.figure.querySelector(".scale")) this.measure();
    });
  }

  exaggerate(times) {
    this.svg.style.setProperty("--k", times);
    const said = this.figure.querySelector(".times");
    said.textContent = times < 1.05 ? "true to scale" : `× ${times < 10 ? times.toFixed(1) : Math.round(times)}`;
  }

  measure() {
    const room = 110 * this.u;
    const power = 10 ** Math.floor(Math.log10(room));
    const length = [5, 2, 1].find((step) => step * power <= room) * power;
    const bar = this.figure.querySelector(".scale");
    bar.style.width = `${length / this.u}px`;
    bar.textContent = length < 1000 ? `${Number(length.toPrecision(1))} m` : `${length / 1000} km`;
  }

  // --- what people do

  point(event) {
    const box = this.stage.getBoundingClientRect();
    return {
      x: this.x + (event.clientX - box.left - this.width / 2) * this.u,
      y: this.y + (event.clientY - box.top - this.height / 2) * this.u,
    };
  }

  listen() {
    const { stage } = this;
    stage.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    stage.addEventListener("pointerdown", (event) => this.press(event));
    stage.addEventListener("pointermove", (event) => this.drag(event));
    stage.addEventListener("pointerleave", () => pointAt(null));
    for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, (event) => this.release(event));
    stage.addEventListener("dragstart", (event) => event.preventDefault());
    stage.addEventListener("dblclick", (event) => this.zoom(event.shiftKey ? 0.5 : 2, this.point(event)));
    stage.addEventListener("keydown", (event) => this.key(event));
    const acts = { in: () => this.zoom(ZOOM), out: () => this.zoom(1 / ZOOM), fit: () => this.fit() };
    for (const button of this.figure.querySelectorAll("[data-act]"))
      button.addEventListener("click", acts[button.dataset.act]);
    for (const box of this.figure.querySelectorAll("[data-toggles]"))
      box.addEventListener("change", () => this.toggle(box));
  }

  toggle(box) {
    for (const layer of this.svg.querySelectorAll(`.${box.dataset.toggles}`)) layer.classList.toggle("off", !box.checked);
  }

  wheel(event) {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1;
    const speed = event.ctrlKey ? 0.01 : 0.0016; // a trackpad's pinch comes with ctrlKey and small steps
    this.zoom(Math.exp(-event.deltaY * lines * speed), this.point(event));
  }

  press(event) {
    if (event.button !== 0 || event.target.closest("button")) return;
    this.pointers.set(event.pointerId, event);
    if (this.pointers.size === 1) this.start = event;
    else this.start = null;
  }

  drag(event) {
    if (event.buttons === 0) this.pointers.delete(event.pointerId); // it was released elsewhere
    if (!this.pointers.has(event.pointerId)) {
      if (event.pointerType === "mouse") pointAt(this, this.point(event));
      return;
    }
    const before = gauge(this.pointers);
    this.pointers.set(event.pointerId, event);
    const after = gauge(this.pointers);
    if (this.start && !far(this.start, event)) return;
    this.start = null;
    this.stage.setPointerCapture(event.pointerId); // only now, so that links in the picture can be clicked
    const at = this.point({ clientX: before.x, clientY: before.y });
    if (before.spread && after.spread) this.zoom(after.spread / before.spread, at);
    const moved = this.point({ clientX: after.x, clientY: after.y });
    this.move(this.x + at.x - moved.x, this.y + at.y - moved.y);
  }

  release(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    if (this.start && event.type === "pointerup") select(nearest(this, this.point(event)));
    this.start = null;
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = PAN * this.width * this.u;
    const acts = {
      "+": () => this.zoom(ZOOM),
      "=": () => this.zoom(ZOOM),
      "-": () => this.zoom(1 / ZOOM),
      0: () => this.fit(),
      Home: () => this.fit(),
      ArrowLeft: () => this.move(this.x - step, this.y),
      ArrowRight: () => this.move(this.x + step, this.y),
      ArrowUp: () => this.move(this.x, this.y - step),
      ArrowDown: () => this.move(this.x, this.y + step),
    };
    if (!acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
  }

  // --- marks

  mark(name, point) {
    const group = this.svg.querySelector(`.${name}`);
    if (!group) return;
    group.classList.toggle("off", !point);
    if (point) group.setAttribute("transform", `translate(${point.x} ${point.y})`);
  }

  say(point) {
    const { dataset } = this.svg;
    if (!this.figure.querySelector(".position")) return;
    const [x, y] = this.frame === "map" ? [+dataset.west + point.x, dataset.north - point.y] : [point.x, point.y];
    const [first, second] = this.frame === "map" ? ["x", "y"] : ["column", "row"];
    this.figure.querySelector(".position").textContent = `${first} ${x.toFixed(1)}, ${second} ${y.toFixed(1)}`;
  }
}

// Middle of the pointers in the window, and their distance.
function gauge(pointers) {
  const all = [...pointers.values()];
  const x = all.reduce((sum, one) => sum + one.clientX, 0) / all.length;
  const y = all.reduce((sum, one) => sum + one.clientY, 0) / all.length;
  const spread = all.length > 1 ? Math.hypot(all[0].clientX - all[1].clientX, all[0].clientY - all[1].clientY) : 0;
  return { x, y, spread };
}

const far = (one, other) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) > 5;

// --- mask and map

// A homography as a matrix of space that leaves z alone.
const inSpace = ([[a, b, c], [d, e, f], [g, h, i]]) => new DOMMatrix([a, d, 0, g, b, e, 0, h, 0, 0, 1, 0, c, f, 0, i]);

function project(matrix, point) {
  const { x, y, w } = matrix.transformPoint(point);
  return w > 0 ? { x: x / w, y: y / w } : null;
}

// Show the ground under the pointer in the other view too.
function pointAt(viewer, point) {
  for (const other of viewers) {
    const way = viewer && ways[viewer.frame + other.frame];
    other.mark("cursor", way ? project(way, point) : null);
  }
  if (viewer) viewer.say(point);
}

function nearest(viewer, point) {
  let best = null;
  let least = REACH * viewer.u;
  for (const match of matches) {
    const at = match[viewer.frame];
    const distance = at ? Math.hypot(at.x - point.x, at.y - point.y) : Infinity;
    if (distance < least) [best, least] = [match, distance];
  }
  return best;
}

function select(match, jump = false) {
  for (const one of matches) one.row.classList.toggle("chosen", one === match);
  for (const viewer of viewers) {
    const at = match && match[viewer.frame];
    viewer.mark("ring", at);
    if (at && jump) viewer.show(at);
  }
  const [number, column, row, x, y, residual] = match ? match.cells : [];
  const said = document.querySelector(".chosen-match");
  if (said) said.textContent = match ? `Match ${number}: ${residual} m apart; mask ${column}, ${row}; map ${x}, ${y}` : "";
}

function readMatch(row) {
  const cells = [...row.cells].map((cell) => cell.textContent);
  const [, column, line, x, y] = cells.map(Number);
  const { west, north } = document.querySelector("svg[data-frame=map]").dataset;
  return { row, cells, mask: { x: column, y: line }, map: { x: x - west, y: north - y } };
}

const viewers = [...document.querySelectorAll("figure.viewer")].map((figure) => new Viewer(figure));
const matches = [...document.querySelectorAll(".matches tbody tr")].map(readMatch);
for (const match of matches) match.row.querySelector("button").addEventListener("click", () => select(match, true));

const ways = {};
const linked = document.querySelector("svg[data-homography]");
if (linked) {
  ways.maskmap = inSpace(JSON.parse(linked.dataset.homography));
  ways.mapmask = ways.maskmap.inverse();
}

for (const button of document.querySelectorAll("button[data-x]")) {
  const { x, y, span } = button.dataset;
  const map = viewers.find((viewer) => viewer.frame === "map");
  button.addEventListener("click", () => {
    map.show({ x: +x, y: +y }, +span);
    map.figure.scrollIntoView({ block: "nearest" });
  });
}
