// Draws the posterior as people understand it: a speedometer, a compass, a map, or dots.
"use strict";

const SVG = "http://www.w3.org/2000/svg";

function shape(parent, name, attributes, text) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
  if (text !== undefined) element.textContent = text;
  parent.appendChild(element);
  return element;
}

const polar = (radius, angle) => [radius * Math.cos(angle), -radius * Math.sin(angle)];

function arc(radius, from, to) {
  const [x0, y0] = polar(radius, from);
  const [x1, y1] = polar(radius, to);
  return `M${x0} ${y0}A${radius} ${radius} 0 ${Math.abs(to - from) > Math.PI ? 1 : 0} ${to > from ? 0 : 1} ${x1} ${y1}`;
}

// Weights gathered into bins, smoothed a little, the highest being one.
function histogram(values, weights, low, high, bins, circular) {
  const counts = new Array(bins).fill(0);
  values.forEach((value, index) => {
    const place = Math.floor(((value - low) / (high - low)) * bins);
    counts[Math.min(bins - 1, Math.max(0, place))] += weights[index];
  });
  const at = (i) => (circular ? counts[(i + bins) % bins] : counts[Math.min(bins - 1, Math.max(0, i))]);
  const smooth = counts.map((count, i) => (at(i - 1) + 2 * count + at(i + 1)) / 4);
  const highest = Math.max(...smooth, 1e-9);
  return smooth.map((value) => value / highest);
}

function drawBelief(svg, belief) {
  svg.replaceChildren();
  if (!belief) return;
  ({ speed: drawSpeed, direction: drawDirection, place: drawPlane, projection: drawPlane })[belief.picture](svg, belief);
}

// Shares of the posterior, along an arc that begins at an angle and turns by another.
function drawMass(svg, shares, start, turn) {
  shares.forEach((share, i) => {
    if (share < 0.02) return;
    const from = start + (turn * i) / shares.length;
    const d = arc(78, from, from + turn / shares.length);
    shape(svg, "path", { d, class: "mass", "stroke-opacity": 0.12 + 0.88 * share });
  });
}

function drawNeedle(svg, length, angle) {
  const [x2, y2] = polar(length, angle);
  shape(svg, "line", { x1: 0, y1: 0, x2, y2, class: "needle" });
  shape(svg, "circle", { cx: 0, cy: 0, r: 5, class: "hub" });
}

function drawSpeed(svg, belief) {
  svg.setAttribute("viewBox", "-110 -100 220 122");
  const angle = (speed) => Math.PI * (1 - Math.min(1, Math.max(0, speed / belief.extent)));
  shape(svg, "path", { d: arc(78, Math.PI, 0), class: "track" });
  const speeds = belief.points.map((p) => p[0]);
  drawMass(svg, histogram(speeds, belief.weights, 0, belief.extent, 36, false), Math.PI, -Math.PI);
  for (let speed = 0; speed <= belief.extent; speed++) {
    const [x, y] = polar(98, angle(speed));
    shape(svg, "text", { x, y: y + 4, class: "tick" }, String(speed));
  }
  drawNeedle(svg, 62, angle(belief.estimate[0]));
  shape(svg, "text", { x: 0, y: 18, class: "tick" }, belief.unit);
}

function drawDirection(svg, belief) {
  if (belief.points.every((p) => Math.abs(p[1]) < 1e-6)) { // forward or backward
    svg.setAttribute("viewBox", "-120 -48 240 96");
    const right = belief.points.reduce((sum, p, i) => sum + (p[0] >= 0 ? belief.weights[i] : 0), 0);
    [[-1, 1 - right], [1, right]].forEach(([way, share]) => {
      const d = `M${way * 8} -14H${way * 60}V-30L${way * 104} 0L${way * 60} 30V14H${way * 8}Z`;
      shape(svg, "path", { d, class: "arrow-frame" });
      shape(svg, "path", { d, class: "arrow", "fill-opacity": share });
      shape(svg, "text", { x: way * 50, y: 5, class: share > 0.55 ? "tick over" : "tick" }, `${Math.round(100 * share)} %`);
    });
    return;
  }
  svg.setAttribute("viewBox", "-140 -114 280 228");
  shape(svg, "circle", { cx: 0, cy: 0, r: 78, class: "track" });
  name(svg, belief.words, 94);
  const angles = belief.points.map((p) => Math.atan2(p[1], p[0]));
  drawMass(svg, histogram(angles, belief.weights, -Math.PI, Math.PI, 48, true), -Math.PI, 2 * Math.PI);
  drawNeedle(svg, 60, Math.atan2(belief.estimate[1], belief.estimate[0]));
}

// The words for right, upwards, left and downwards, as far from the middle; the films have the same directions.
function name(svg, words, far) {
  [[far, 5, "start"], [0, 2 - far, "middle"], [-far, 5, "end"], [0, far + 8, "middle"]].forEach(([x, y, anchor], i) => {
    shape(svg, "text", { x, y, class: `tick ${anchor}` }, words[i]);
  });
}

function drawPlane(svg, belief) {
  const place = belief.picture === "place";
  svg.setAttribute("viewBox", place ? "-146 -121 292 244" : "-110 -110 220 220"); // with room for words around it
  const scale = 100 / belief.extent;
  shape(svg, "rect", { x: -104, y: -104, width: 208, height: 208, rx: 10, class: "map" });
  // Circles as in the films: at whole metres, where there is room.
  const rings = [];
  for (let r = 1; belief.unit === "m" && r < belief.extent; r += belief.extent > 4 ? 2 : 1) rings.push(r);
  if (place) shape(svg, "path", { d: "M-104 0H104M0 -104V104", class: "grid" });
  rings.forEach((r) => shape(svg, "circle", { cx: 0, cy: 0, r: r * scale, class: "grid" }));
  const heaviest = Math.max(...belief.weights);
  belief.points.forEach((point, i) => {
    const strength = belief.weights[i] / heaviest;
    if (strength < 0.01) return;
    const at = { cx: point[0] * scale, cy: -point[1] * scale };
    shape(svg, "circle", { ...at, r: 7, class: "cloud", "fill-opacity": 0.05 + 0.22 * strength });
  });
  if (place) { // above the dots, which would hide it
    const words = shape(svg, "g", { class: "above" });
    shape(words, "circle", { cx: 0, cy: 0, r: 3, class: "start" });
    shape(words, "text", { x: -5, y: -6, class: "small end" }, "start");
    rings.map((r) => [0.7 * r * scale, r]).forEach(([x, r]) => shape(words, "text", { x, y: x + 4, class: "small middle" }, `${r} m`));
    name(svg, belief.words, 110);
  }
  const [x, y] = [belief.estimate[0] * scale, -belief.estimate[1] * scale];
  shape(svg, "circle", { cx: x, cy: y, r: 8, class: "ring" });
  shape(svg, "circle", { cx: x, cy: y, r: 2.5, class: "hub" });
}
