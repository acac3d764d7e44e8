// Pictures that answer: a text for the dot that is pointed at, and zoom. Without it the page is whole.
"use strict";
const SVG = "http://www.w3.org/2000/svg";
const NEAR = 18; // of the pointer, on the screen [px]
const LARGEST = 200; // zoom
const CLOCK = [0.1, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600];

function make(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  if (text !== undefined) made.textContent = text;
  parent.append(made);
  return made;
}

function numbers(text) { return text.split(" ").map(Number); }

function steps(low, high, kind) {
  const least = (high - low) / 4.5;
  const power = 10 ** Math.floor(Math.log10(least));
  let step = power * [1, 2, 5, 10].find(each => each * power >= least * 0.999);
  if (kind === "time" && step >= 0.1) step = CLOCK.find(each => each >= least) || 21600;
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(k * step);
  return [found, step];
}

function called(value, step, kind) {
  if (kind === "time") {
    const two = number => String(Math.floor(number)).padStart(2, "0");
    const day = ((value + 1e-6) % 86400 + 86400) % 86400;
    const minutes = two(day / 3600) + ":" + two(day / 60 % 60);
    if (step >= 60) return minutes;
    return minutes + ":" + (step < 1 ? (day % 60).toFixed(1).padStart(4, "0") : two(day % 60));
  }
  const shown = kind === "ra" ? (value % 360 + 360) % 360 : value;
  return shown.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9))).replace("-", "\u2212");
}

const tip = document.createElement("div");
tip.id = "tip";
tip.setAttribute("role", "status");
document.body.append(tip);

class Picture {
  constructor(svg) {
    this.svg = svg;
    this.scale = 1;
    this.shift = [0, 0];
    this.chosen = -1;
    this.zooms = Boolean(svg.dataset.box || svg.dataset.turn);
    if (this.zooms) this.addButtons();
    svg.addEventListener("pointermove", event => this.point(event));
    svg.addEventListener("pointerdown", event => this.press(event));
    for (const end of ["pointerup", "pointercancel"])
      svg.addEventListener(end, event => this.release(event));
    svg.addEventListener("pointerleave", event => {
      if (event.pointerType === "mouse" && !this.pressed.size) this.choose(-1);
    });
    svg.addEventListener("blur", () => this.choose(-1));
    svg.addEventListener("keydown", event => this.key(event));
    svg.addEventListener("wheel", event => this.wheel(event), { passive: false });
    this.pressed = new Map();
  }

  addButtons() {
    const bar = document.createElement("div");
    bar.className = "tools";
    for (const [sign, name, act] of [["+", "Zoom in", () => this.zoom(2)],
      ["\u2212", "Zoom out", () => this.zoom(0.5)], ["\u21ba", "Show all", () => this.reset()]]) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = sign;
      button.title = name;
      button.setAttribute("aria-label", name + ": " + this.svg.getAttribute("aria-label"));
      button.addEventListener("click", () => { this.prepare(); act(); });
      bar.append(button);
    }
    this.svg.after(bar);
  }

  // Once it is used: a picture in a closed part of the page has no measures before.
  prepare() {
    if (this.dots) return;
    this.view = this.svg.viewBox.baseVal;
    this.dots = [...this.svg.querySelectorAll("[data-t]")];
    this.places = this.dots.map(dot => this.middle(dot));
    this.ring = make("circle", { r: 6, class: "ring", visibility: "hidden" }, this.svg);
    if (!this.svg.dataset.box) return;
    this.box = numbers(this.svg.dataset.box);
    const data = [...this.svg.querySelectorAll(".data")];
    const marks = [...this.svg.querySelectorAll(".marks path, .data use, .data [data-t]")]
      .filter(mark => !mark.closest("defs")).map(mark => [mark, this.middle(mark)]);
    const texts = data.filter(group => group.querySelector("text")).map(group => {
      const at = this.middle(group); // its dot, which it stays beside
      const apart = place => Math.hypot(place[0] - at[0], place[1] - at[1]);
      return [group, this.places.reduce((best, place) =>
        apart(place) < apart(best) ? place : best, this.places[0] || at)];
    });
    this.fixed = [...marks, ...texts];
    const name = "box" + Picture.count++;
    const [x, y, width, height] = this.box;
    const clip = make("clipPath", { id: name }, make("defs", {}, this.svg));
    make("rect", { x, y, width, height }, clip);
    const outer = make("g", { "clip-path": `url(#${name})` }, this.svg);
    this.moved = make("g", { class: "moved" }, outer);
    this.svg.append(this.ring);
    for (const each of data.flatMap(group => [group, ...group.querySelectorAll("[clip-path]")]))
      each.removeAttribute("clip-path");
    this.moved.append(...data);
    this.lines = [...this.moved.querySelectorAll("path:not([data-t])")]
      .filter(path => !path.closest("defs, .marks")).map(path => [path, getComputedStyle(path)])
      .map(([path, style]) => [path, parseFloat(style.strokeWidth),
        (style.strokeDasharray.match(/[\d.]+/g) || []).map(Number)]);
    this.own = make("g", { class: "own" }, this.svg);
  }

  middle(element) {
    const box = element.getBBox();
    return [box.x + box.width / 2, box.y + box.height / 2];
  }

  shown(place) { return place.map((value, k) => this.scale * value + this.shift[k]); }

  at(event) {
    const rect = this.svg.getBoundingClientRect();
    this.unit = rect.width / this.view.width;
    return [(event.clientX - rect.left) / this.unit, (event.clientY - rect.top) / this.unit];
  }

  point(event) {
    this.prepare();
    const at = this.at(event);
    if (this.pressed.has(event.pointerId)) { this.drag(event, at); return; }
    let nearest = -1, least = NEAR / this.unit;
    this.places.forEach((place, k) => {
      const [x, y] = this.shown(place);
      const apart = Math.hypot(x - at[0], y - at[1]);
      if (apart < least && this.inside([x, y])) { nearest = k; least = apart; }
    });
    this.choose(nearest);
  }

  inside([x, y]) {
    if (!this.box || this.scale === 1) return true;
    const [left, top, width, height] = this.box;
    return x >= left && x <= left + width && y >= top && y <= top + height;
  }

  choose(k) {
    if (!this.dots) return;
    if (k >= 0 && Picture.active && Picture.active !== this) Picture.active.choose(-1);
    Picture.active = k >= 0 ? this : null;
    this.chosen = k;
    const dot = this.dots[k];
    this.ring.setAttribute("visibility", dot ? "visible" : "hidden");
    tip.classList.toggle("on", Boolean(dot));
    this.svg.classList.toggle("leads", Boolean(dot && dot.dataset.h));
    if (!dot) return;
    const [x, y] = this.shown(this.places[k]);
    this.ring.setAttribute("cx", x);
    this.ring.setAttribute("cy", y);
    tip.textContent = dot.dataset.t + (dot.dataset.h ? " \u2192" : "");
    const rect = this.svg.getBoundingClientRect();
    const unit = rect.width / this.view.width;
    const left = rect.left + x * unit, top = rect.top + y * unit;
    const width = document.documentElement.clientWidth;
    tip.style.left = Math.max(8, Math.min(left + 12, width - tip.offsetWidth - 8)) + "px";
    tip.style.top = Math.max(8, top - tip.offsetHeight - 12) + "px";
  }

  press(event) {
    this.prepare();
    this.point(event);
    this.pressed.set(event.pointerId, this.at(event));
    this.start = this.at(event);
    if (this.scale > 1) this.svg.setPointerCapture(event.pointerId);
  }

  release(event) {
    const start = this.start, at = this.at(event);
    this.pressed.delete(event.pointerId);
    const still = start && Math.hypot(at[0] - start[0], at[1] - start[1]) * this.unit < 5;
    if (event.type === "pointerup" && event.pointerType === "mouse" && still) this.follow();
  }

  drag(event, at) {
    if (!this.zooms) return;
    const before = this.pressed.get(event.pointerId);
    const others = [...this.pressed].filter(([id]) => id !== event.pointerId);
    if (others.length) {
      const other = others[0][1];
      const apart = point => Math.hypot(point[0] - other[0], point[1] - other[1]);
      this.zoom(apart(at) / Math.max(apart(before), 1), other);
    } else this.slide(before, at);
    this.pressed.set(event.pointerId, at);
  }

  slide(before, at) {
    if (this.scale === 1) return;
    this.shift = this.shift.map((value, k) => value + at[k] - before[k]);
    this.draw();
  }

  wheel(event) {
    // A page scrolls past a picture: only one that has the focus, or with Ctrl, zooms.
    if (!this.zooms || !(event.ctrlKey || document.activeElement === this.svg)) return;
    event.preventDefault();
    this.prepare();
    this.zoom(Math.exp(-event.deltaY / 300), this.at(event));
  }

  key(event) {
    this.prepare();
    const way = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in way && event.shiftKey && this.box) {
      this.shift = this.shift.map((value, k) => value + way[event.key][k] * this.box[k + 2] / 6);
      this.draw();
    } else if (event.key === "ArrowRight") this.step(1);
    else if (event.key === "ArrowLeft") this.step(-1);
    else if (event.key === "Enter") this.follow();
    else if ("+=".includes(event.key)) this.zoom(1.5);
    else if (event.key === "-") this.zoom(1 / 1.5);
    else if (event.key === "0" || event.key === "Escape") this.reset();
    else return;
    event.preventDefault();
  }

  step(by) {
    const n = this.dots.length;
    for (let k = 1; k <= n; k++) {
      const next = ((this.chosen < 0 && by < 0 ? 0 : this.chosen) + by * k + n * 2) % n;
      if (this.inside(this.shown(this.places[next]))) { this.choose(next); return; }
    }
  }

  follow() {
    const dot = this.dots[this.chosen];
    if (dot && dot.dataset.h) location.hash = dot.dataset.h;
  }

  zoom(factor, about) {
    if (!this.box) return;
    const [left, top, width, height] = this.box;
    const middle = [left + width / 2, top + height / 2];
    about = about || (this.chosen < 0 ? middle : this.shown(this.places[this.chosen]));
    const scale = Math.min(Math.max(this.scale * factor, 1), LARGEST);
    this.shift = this.shift.map((value, k) =>
      about[k] - (about[k] - value) * scale / this.scale);
    this.scale = scale;
    this.draw();
  }

  reset() { this.scale = 1; this.shift = [0, 0]; if (this.box) this.draw(); }

  draw() {
    const k = this.scale;
    this.shift = this.shift.map((value, axis) => {
      const low = this.box[axis], high = low + this.box[axis + 2];
      return Math.min(low * (1 - k), Math.max(high * (1 - k), value));
    });
    this.moved.setAttribute("transform", `translate(${this.shift}) scale(${k})`);
    for (const [each, [x, y]] of this.fixed)
      each.setAttribute("transform", `translate(${x} ${y}) scale(${1 / k}) translate(${-x} ${-y})`);
    for (const [path, width, dashes] of this.lines) {
      path.style.strokeWidth = width / k;
      if (dashes.length) path.style.strokeDasharray = dashes.map(each => each / k).join(" ");
    }
    this.svg.classList.toggle("zoomed", k > 1);
    this.axes();
    if (this.chosen >= 0) this.choose(this.chosen);
  }

  axes() {
    this.own.replaceChildren();
    if (this.scale === 1) return;
    const [left, top, width, height] = this.box;
    const style = "font-size: " + getComputedStyle(this.svg.querySelector(".tick text")).fontSize;
    for (const [axis, from, length] of [["x", left, width], ["y", top, height]]) {
      const number = axis === "x" ? 0 : 1;
      const [first, last] = numbers(this.svg.dataset[axis]);
      const value = place => first + ((place - this.shift[number]) / this.scale - from) / length *
        (last - first);
      const ends = [value(from), value(from + length)];
      const kind = axis === "x" ? this.svg.dataset.kind : "number";
      const [ticks, step] = steps(Math.min(...ends), Math.max(...ends), kind);
      for (const tick of ticks) {
        const place = from + (tick - ends[0]) / (ends[1] - ends[0]) * length;
        const says = called(tick, step, kind);
        if (axis === "x") this.tick(place, top + height, 0, 3, place, top + height + 11, "middle", says, style);
        else this.tick(left, place, -3, 0, left - 5, place + 2.6, "end", says, style);
      }
    }
  }

  tick(x, y, dx, dy, atX, atY, anchor, says, style) {
    make("path", { d: `M${x} ${y}l${dx} ${dy}` }, this.own);
    make("text", { x: atX, y: atY, style: `${style}; text-anchor: ${anchor}` }, this.own, says);
  }
}

const EARTH = 6.378137; // 1,000 km
const STEPS = 6; // parts of a line of sight, each of which may be behind the Earth

// A globe that turns. Its lines and dots have places in space, in units of 1,000 km.
class Globe extends Picture {
  constructor(svg) {
    super(svg);
    this.first = numbers(svg.dataset.turn);
    this.turn = [...this.first];
  }

  prepare() {
    if (this.dots) return;
    super.prepare();
    const read = element => {
      const all = numbers(element.dataset.p);
      return Array.from({ length: all.length / 3 }, (_, k) => all.slice(3 * k, 3 * k + 3));
    };
    this.points = this.dots.map(dot => read(dot)[0]);
    const parts = ([from, to]) => Array.from({ length: STEPS + 1 }, (_, k) =>
      from.map((value, axis) => value + k / STEPS * (to[axis] - value)));
    this.paths = [...this.svg.querySelectorAll("path[data-p]")].map(path =>
      [path, path.closest(".sight") ? parts(read(path)) : read(path)]);
    this.earth = this.svg.querySelector(".earth");
    this.draw();
  }

  shown(place) { return place; }

  inside([x, y]) { return x >= 0 && y >= 0 && x <= this.view.width && y <= this.view.height; }

  press(event) {
    super.press(event);
    this.svg.setPointerCapture(event.pointerId);
  }

  slide(before, at) {
    const angle = 90 / this.view.width / Math.sqrt(this.scale);
    this.turned(angle * (before[0] - at[0]), angle * (at[1] - before[1]));
  }

  turned(east, north) {
    this.turn = [this.turn[0] + east, Math.max(-90, Math.min(90, this.turn[1] + north))];
    this.draw();
  }

  key(event) {
    const way = { ArrowLeft: [-15, 0], ArrowRight: [15, 0], ArrowUp: [0, 15], ArrowDown: [0, -15] };
    if (!(event.key in way && event.shiftKey)) { super.key(event); return; }
    this.prepare();
    this.turned(...way[event.key]);
    event.preventDefault();
  }

  zoom(factor) {
    this.scale = Math.min(Math.max(this.scale * factor, 0.5), LARGEST);
    this.draw();
  }

  reset() {
    this.scale = 1;
    this.turn = [...this.first];
    this.draw();
  }

  draw() {
    const unit = Number(this.svg.dataset.scale) * this.scale, middle = this.view.width / 2;
    const [lon, lat] = this.turn.map(angle => angle * Math.PI / 180);
    const [s, c, sn, cn] = [Math.sin(lon), Math.cos(lon), Math.sin(lat), Math.cos(lat)];
    const place = ([x, y, z]) => {
      const right = c * y - s * x, outward = c * x + s * y;
      const up = cn * z - sn * outward, depth = cn * outward + sn * z;
      const seen = depth >= 0 || Math.hypot(right, up) > EARTH;
      return [middle + unit * right, middle - unit * up, seen];
    };
    this.earth.setAttribute("r", EARTH * unit);
    for (const [path, points] of this.paths) {
      let before = false, drawn = "";
      for (const [x, y, seen] of points.map(place)) {
        if (seen) drawn += (before ? "L" : "M") + x.toFixed(1) + " " + y.toFixed(1);
        before = seen;
      }
      path.setAttribute("d", drawn);
    }
    this.places = this.points.map((point, k) => {
      const [x, y, seen] = place(point), dot = this.dots[k];
      dot.setAttribute("x", x);
      dot.setAttribute("y", y);
      dot.setAttribute("visibility", seen ? "visible" : "hidden");
      return seen ? [x, y] : [NaN, NaN];
    });
    if (this.chosen >= 0) this.choose(this.inside(this.places[this.chosen]) ? this.chosen : -1);
  }
}
Picture.count = 0;
Picture.active = null; // the one with a text
addEventListener("scroll", () => { if (Picture.active) Picture.active.choose(Picture.active.chosen); },
  { passive: true });
addEventListener("pointerdown", event => {
  if (Picture.active && !event.target.closest("figure")) Picture.active.choose(-1);
});

for (const svg of document.querySelectorAll("svg.plot[tabindex]"))
  svg.dataset.turn ? new Globe(svg) : new Picture(svg);
document.documentElement.classList.add("live");

// A part that is closed opens where a link leads to it, and all of them for printing.
function open() {
  const part = location.hash.length > 1 && document.getElementById(location.hash.slice(1));
  if (part && part.tagName === "DETAILS") { part.open = true; part.scrollIntoView(); }
}
addEventListener("hashchange", open);
addEventListener("click", event => { if (event.target.closest('a[href^="#object-"]')) setTimeout(open); });
addEventListener("beforeprint", () => { for (const each of document.querySelectorAll("details")) each.open = true; });
open();
