"use strict";
// The overlay of the 3D picture: axes, what was found, devices and their estimates, paths and positions of the UAVs.

const UAV_COLOURS = ["#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9"];  // Okabe and Ito
const UNKNOWN = "#f08a00";
const MAX_NAMES = 60;  // of devices, beside their marks
const LABEL_SHIFTS = [0, 14, -14, 28, -28, 42, -42];  // upwards, in pixels
const FONT = "12px system-ui, sans-serif";

function path(context, stage, points, colour, width) {
  context.beginPath();
  let drawn = false;  // whether the pen is down
  for (const point of points) {
    const at = point && stage.pixel(...point);
    if (!at) { drawn = false; continue; }
    if (drawn) context.lineTo(...at); else context.moveTo(...at);
    drawn = true;
  }
  Object.assign(context, {strokeStyle: colour, lineWidth: width, lineJoin: "round"});
  context.stroke();
}

const written = number => number.toString().replace("-", "−");

// A text over a point. It stays in the picture, and moves up or down where another one or a mark is.
function label(context, stage, text, [x, y], colour = stage.ink) {
  Object.assign(context, {font: FONT, textAlign: "center", lineWidth: 3, fillStyle: colour, strokeStyle: stage.halo});
  const half = context.measureText(text).width / 2 + 3;
  x = Math.max(half, Math.min(x, stage.width - half));
  const covers = up => stage.taken.some(([left, right, top, bottom]) =>
    left < x + half && x - half < right && top < y - up + 3 && y - up - 10 < bottom);
  y -= LABEL_SHIFTS.find(up => !covers(up)) ?? 0;
  stage.taken.push([x - half, x + half, y - 10, y + 3]);
  context.strokeText(text, x, y);
  context.fillText(text, x, y);
}

function ring(context, [x, y], colour) {
  context.beginPath();
  context.arc(x, y, 5, 0, 2 * Math.PI);
  Object.assign(context, {strokeStyle: colour, lineWidth: 2});
  context.stroke();
}

function mark(context, stage, kind, [x, y], size, colour) {
  stage.taken.push([x - size, x + size, y - size, y + size]);
  context.beginPath();
  if (kind === "cross") {
    context.moveTo(x - size, y - size); context.lineTo(x + size, y + size);
    context.moveTo(x - size, y + size); context.lineTo(x + size, y - size);
    Object.assign(context, {strokeStyle: colour, lineWidth: 2.5});
    context.stroke();
    return;
  }
  if (kind === "diamond") {
    context.moveTo(x, y - size); context.lineTo(x + size, y); context.lineTo(x, y + size); context.lineTo(x - size, y);
    context.closePath();
  } else context.arc(x, y, size, 0, 2 * Math.PI);
  Object.assign(context, {fillStyle: colour, strokeStyle: "#fff", lineWidth: 1.5});
  context.fill();
  context.stroke();
}

// A round number of metres that divides `length` into at most six parts.
function roundStep(length) {
  const power = 10 ** Math.floor(Math.log10(length / 5));
  return [1, 2, 5, 10].map(part => part * power).find(step => length / step <= 6);
}

function drawAxes(context, stage) {
  const [x0, x1, y0, y1] = stage.data.bounds, side = Math.max(x1 - x0, y1 - y0);
  const step = roundStep(side), off = 0.03 * side;
  path(context, stage, [[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0], [x0, y0, 0]], "#9aa5ad", 1);
  if (stage.width < 500) return;  // no room for numbers
  const write = (at, end, way, x, y) => {
    const pixel = stage.pixel(x, y, 0);
    if (pixel) label(context, stage, written(Math.round(at)) + (at + step > end ? ` m ${way}` : ""), pixel);
  };
  for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) write(x, x1, "east", x, y0 - off);
  for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) write(y, y1, "north", x1 + 1.3 * off, y);
}

// The part of a circle that is over the ground of the city.
function circle(context, stage, [x, y, z], radius, dashes) {
  const [x0, x1, y0, y1] = stage.data.bounds, points = [];
  for (let n = 0; n <= 96; n++) {
    const at = [x + radius * Math.cos(n * Math.PI / 48), y + radius * Math.sin(n * Math.PI / 48), z];
    points.push(at[0] >= x0 && at[0] <= x1 && at[1] >= y0 && at[1] <= y1 ? at : null);
  }
  context.setLineDash(dashes);
  path(context, stage, points, stage.found, 1.5);
  context.setLineDash([]);
}

// What a close-loop found: a building as its edges, anything else as a cross, with its name.
function drawFound(context, stage) {
  for (const {text, x, y, outline, height} of stage.data.found) {
    const corners = outline ?? [[x, y]], raised = z => corners.map(([east, north]) => [east, north, z]);
    if (outline) for (const line of [raised(0), raised(height), ...corners.map(at => [[...at, 0], [...at, height]])])
      path(context, stage, line, stage.cause, 2.5);
    const at = stage.pixel(x, y, height);
    if (!at) continue;
    if (!outline) mark(context, stage, "cross", at, 7, stage.cause);
    label(context, stage, text, [at[0], at[1] - 12], stage.cause);
  }
}

function drawDevices(context, stage) {
  const {devices} = stage.data;
  for (const {name, estimate, true: position, radius_m: radius, located, second} of devices) {
    if (!estimate) continue;
    const [x, y, z] = estimate;
    if (position) path(context, stage, [position, estimate], stage.found, 1.5);
    if (radius > 0) circle(context, stage, estimate, radius, located ? [] : [6, 5]);
    const place = second && stage.pixel(second[0], second[1], z);
    if (place) ring(context, place, stage.found);
    const at = stage.pixel(x, y, z);
    if (!at) continue;
    mark(context, stage, "cross", at, 5, stage.found);
    const within = radius === null ? "" : ` ± ${radius.toFixed(0)} m`;
    if (devices.length <= MAX_NAMES) label(context, stage, name + within, [at[0], at[1] + 19], stage.found);
  }
  for (const device of devices) {
    const at = device.true && stage.pixel(...device.true);
    if (!at) continue;
    const anchor = device.role === "anchor";
    mark(context, stage, anchor ? "diamond" : "circle", at, anchor ? 6 : 5, anchor ? stage.ink : UNKNOWN);
    if (devices.length <= MAX_NAMES) label(context, stage, device.name, [at[0], at[1] - 9]);
  }
}

function drawFlight(context, stage, uavs) {
  uavs.forEach(({trail}, number) => path(context, stage, trail, UAV_COLOURS[number % UAV_COLOURS.length], 2.5));
  uavs.forEach(({name, position}, number) => {
    const at = stage.pixel(...position);
    if (!at) return;
    mark(context, stage, "circle", at, 7, UAV_COLOURS[number % UAV_COLOURS.length]);
    label(context, stage, name, [at[0], at[1] - 11]);
  });
}
