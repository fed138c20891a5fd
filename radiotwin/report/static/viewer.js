"use strict";
// The controls: which map or links, device and altitude is shown, and which moment of which flight. The page
// holds all data as JSON (viewer_data.py); nothing is fetched.

const NOT_DETECTED = -32768;  // stands for NaN among levels (viewer_data.py)
const PLAY_MS = 40, PLAY_FRAMES = 400;
const HOVER_PIXELS = 8;
const HOLES = "Holes: not detected.", DOTS = "Each dot is a held-out link, at the position of its moving end; click one for its levels.";

const control = name => document.getElementById("control-" + name);
const chosen = name => Number(control(name).value);

// Replaces every packed array by a typed one.
function unpack(value) {
  if (Array.isArray(value)) return value.map(unpack);
  if (value === null || typeof value !== "object") return value;
  if (value.data === undefined || value.type === undefined)
    return Object.fromEntries(Object.entries(value).map(([key, each]) => [key, unpack(each)]));
  const kind = {float32: Float32Array, int32: Int32Array, int16: Int16Array, uint8: Uint8Array}[value.type];
  const letters = atob(value.data), bytes = new Uint8Array(letters.length);
  for (let n = 0; n < letters.length; n++) bytes[n] = letters.charCodeAt(n);  // Uint8Array.from takes a second for 3 MB
  return new kind(bytes.buffer);
}

const data = unpack(JSON.parse(document.getElementById("radiotwin-data").textContent));
const views = data.maps.flatMap(map => map.fields.map(field => ({map, field, label: field.label})));
for (const field of data.links?.fields ?? []) views.push({field, label: field.label});
const view = () => views[chosen("view")];

function colourOf(scale, share) {  // (r, g, b) of 0 to 255
  const colours = data.scales[scale];
  return colours[Math.round(Math.min(Math.max(share, 0), 1) * (colours.length - 1))];
}

function fill(select, labels) {
  select.replaceChildren(...labels.map((text, value) => new Option(text, value)));
  select.parentElement.hidden = labels.length === 0;
  select.disabled = labels.length < 2;
}

function refill(name, labels) {  // keeps the choice where it is still available
  const before = control(name).selectedOptions[0]?.text;
  fill(control(name), labels);
  if (labels.includes(before)) control(name).value = labels.indexOf(before);
}

function chooseView() {
  const shown = view();
  refill("device", !shown ? [] : shown.map ? shown.map.devices : ["all devices", ...data.links.devices]);
  refill("altitude", shown?.map ? shown.map.z.map(z => `${z} m`) : []);
  drawView();
}

function ticksBetween(low, high) {
  const step = roundStep(high - low), ticks = [];
  for (let at = Math.ceil(low / step) * step; at <= high; at += step) ticks.push(Number(at.toFixed(6)));
  return ticks;
}

function drawView() {
  const shown = view();
  if (!shown) return;
  const {kind: scale, low, high, title} = shown.field;
  const share = value => (value - low) / (high - low);
  if (shown.map) {
    const {map} = shown, cells = levelsOf(shown), rgba = new Uint8Array(4 * cells.length);
    cells.forEach((level, n) => { if (level !== null) rgba.set([...colourOf(scale, share(level)), 255], 4 * n); });
    stage.showSlice(rgba, map.x.length, map.y.length, map.x[0], map.y[0], map.step_m, map.z[chosen("altitude")]);
  } else {
    const links = linksOf(shown);
    stage.showDots(links.flatMap(n => [data.links.x[n], data.links.y[n], data.links.z[n]]),
                   links.flatMap(n => colourOf(scale, share(shown.field.values[n] / 100)).map(part => part / 255)));
  }
  control("only").parentElement.hidden = Boolean(shown.map) || !data.links.time;
  const bar = control("colours"), stops = data.scales[scale].map(colour => `rgb(${colour})`), los = scale === "los";
  bar.style.background = los ? `linear-gradient(to right, ${stops[0]} 50%, ${stops.at(-1)} 50%)`
                             : `linear-gradient(to right, ${stops})`;
  control("title").textContent = title;
  const ticks = los ? [[0.25, "no"], [0.75, "yes"]] : ticksBetween(low, high).map(at => [share(at), written(at)]);
  bar.replaceChildren(...ticks.map(([at, text]) => {
    const tick = Object.assign(document.createElement("span"), {textContent: text});
    tick.style.left = `${100 * at}%`;
    return tick;
  }));
  bar.setAttribute("aria-label", `${title}, from ${ticks[0]?.[1]} to ${ticks.at(-1)?.[1]}`);
  control("legend").textContent = !shown.map ? DOTS : scale === "los" ? "" : HOLES;
  stage.redraw();
}

// Levels of the chosen slice, south-west first; null where nothing is detected.
function levelsOf({map, field}) {
  const size = map.x.length * map.y.length, start = (chosen("device") * map.z.length + chosen("altitude")) * size;
  return Array.from(field.values.subarray(start, start + size),
                    value => field.kind === "los" ? value : value === NOT_DETECTED ? null : value / 100);
}

// Indices of the links that the chosen view shows: of a device, of a flight up to the chosen time.
function linksOf({field}) {
  const {links} = data, device = chosen("device") - 1, only = control("only").checked;
  const flight = links.flights.indexOf(data.flights[chosen("flight")]?.name);
  return Array.from(links.x.keys()).filter(n => field.values[n] !== NOT_DETECTED && (device < 0 || links.device[n] === device)
    && (!only || (links.flight[n] === flight && links.time[n] <= chosen("time") + 1e-3)));
}

// Flights
// Index of the last sample before a time, and the position interpolated to that time.
function positionAt(track, time) {
  let low = 0, high = track.t.length - 1;
  if (time >= track.t[high]) return [high, [track.x[high], track.y[high], track.z[high]]];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (track.t[middle] <= time) low = middle; else high = middle;
  }
  const share = Math.max(0, (time - track.t[low]) / Math.max(track.t[high] - track.t[low], 1e-9));
  return [low, ["x", "y", "z"].map(axis => track[axis][low] + share * (track[axis][high] - track[axis][low]))];
}

function uavsNow() {
  const flight = data.flights[chosen("flight")];
  return !flight ? [] : flight.uavs.map(track => {
    const [last, position] = positionAt(track, chosen("time")), trail = [];
    for (let n = 0; n <= last; n++) trail.push([track.x[n], track.y[n], track.z[n]]);
    return {name: track.name, position, trail: [...trail, position]};
  });
}

function showTime() {
  control("clock").textContent = `${chosen("time").toFixed(0)} of ${data.flights[chosen("flight")].end_s.toFixed(0)} s`;
  if (control("only").checked && !view()?.map) drawView(); else stage.redraw();
}

function chooseFlight() {  // at its end, where all of its path is shown
  const flight = data.flights[chosen("flight")], slider = control("time");
  if (!flight) return;
  slider.max = Math.max(flight.end_s, 1e-3);
  slider.step = slider.max / 1000;
  slider.value = slider.max;
  showTime();
}

let player = null;
function play() {
  const slider = control("time"), end = Number(slider.max);
  if (player) {
    clearInterval(player);
    player = null;
  } else {
    if (chosen("time") >= end) slider.value = 0;
    player = setInterval(() => {
      slider.value = chosen("time") + end / PLAY_FRAMES;
      showTime();
      if (chosen("time") >= end) play();
    }, PLAY_MS);
  }
  control("play").textContent = player ? "❚❚" : "▶";
  control("play").setAttribute("aria-label", player ? "pause" : "play");
}

let picked = null;  // a link
function linkUnder(event) {
  const box = stage.container.getBoundingClientRect(), {x, y, z} = data.links;
  return linksOf(view()).find(n => {
    const at = stage.pixel(x[n], y[n], z[n]);
    return at && Math.hypot(at[0] + box.left - event.clientX, at[1] + box.top - event.clientY) < HOVER_PIXELS;
  }) ?? null;
}

// What is known of a link: residual, and levels where the file has them.
function textOf(n) {
  const {links} = data, measured = links.fields.find(({kind}) => kind === "gain");
  const shown = view().field.interval_db ? view().field : links.fields[1];  // before, or else after
  const residual = shown.values[n] / 100, ends = shown.interval_db[links.los[n]];
  const what = [links.devices[links.device[n]], links.flights[links.flight[n]],
                ...links.time ? [`${links.time[n].toFixed(0)} s`] : [], links.los[n] ? "LoS" : "NLoS"].join(", ");
  if (!measured || measured.values[n] === NOT_DETECTED || shown.values[n] === NOT_DETECTED) return `${what}: ${written(residual.toFixed(1))} dB`;
  const level = measured.values[n] / 100, predicted = level - residual;
  const [read, expected, low, high] = [level, predicted, predicted + ends[0], predicted + ends[1]].map(
    each => written(each.toFixed(1)));
  return `${what}: measured ${read}, predicted ${expected} (90 %: ${low} to ${high}) ${links.unit}`;
}

// Points of each path of a link that is in the page.
function pathsOf(n) {
  const {link, end, points} = data.links.paths ?? {link: []}, found = [];
  for (let one = 0; one < link.length; one++) {
    if (link[one] !== n) continue;
    const corners = [];
    for (let at = one ? end[one - 1] : 0; at < end[one]; at++) corners.push(Array.from(points.subarray(3 * at, 3 * at + 3)));
    found.push(corners);
  }
  return found;
}

function drawPicked(context) {
  if (picked === null || !view() || view().map) return;
  const {links, devices} = data, at = [links.x[picked], links.y[picked], links.z[picked]];
  const device = devices.find(({name}) => name === links.devices[links.device[picked]]);
  context.setLineDash(links.los[picked] ? [] : [4, 4]);
  path(context, stage, [at, device?.estimate ?? device?.true], stage.ink, 1.5);
  context.setLineDash([]);
  for (const points of pathsOf(picked)) path(context, stage, points, UNKNOWN, 2);
  const pixel = stage.pixel(...at);
  if (pixel) ring(context, pixel, stage.found);
}

// The level under the pointer
function textUnder(event) {
  const shown = view();
  if (!shown) return "";
  if (!shown.map) {
    const n = linkUnder(event) ?? picked;
    return n === null ? "" : textOf(n);
  }
  const {map, field} = shown, z = map.z[chosen("altitude")], at = stage.under(event, z);
  if (!at) return "";
  const column = Math.round((at.x - map.x[0]) / map.step_m), row = Math.round((at.y - map.y[0]) / map.step_m);
  if (column < 0 || row < 0 || column >= map.x.length || row >= map.y.length) return "";
  const level = levelsOf(shown)[row * map.x.length + column];
  const text = level === null ? "not detected" : field.kind !== "los" ? written(level.toFixed(1)) + ` ${field.unit}`
    : level ? "line of sight" : "no line of sight";
  return `(${[map.x[column], map.y[row], z].map(written).join(", ")}) m: ${text}`;
}

let stage = null;
function start() {
  const container = document.getElementById("viewer");
  try {
    stage = new Stage(container, data);
  } catch (error) {
    container.textContent = "The city cannot be drawn without WebGL, which this browser does not provide: " + error.message;
    return;
  }
  stage.drawings.push(context => drawAxes(context, stage), context => drawFlight(context, stage, uavsNow()),
                      context => drawFound(context, stage), drawPicked,
                      context => { if (control("devices").checked) drawDevices(context, stage); });
  stage.pick = event => {
    picked = view() && !view().map ? linkUnder(event) : null;
    control("hover").textContent = textUnder(event);
    stage.redraw();
  };
  stage.hover = event => { control("hover").textContent = textUnder(event); };
  fill(control("view"), views.map(({label}) => label));
  control("view").value = Math.max(views.findIndex(({map}) => map?.name.startsWith("twin")), 0);
  fill(control("flight"), data.flights.map(({name}) => name));
  document.getElementById("flight-controls").hidden = data.flights.length === 0;
  document.getElementById("scale").hidden = views.length === 0;
  control("buildings").parentElement.hidden = !data.city;
  control("view").onchange = chooseView;
  control("device").onchange = control("altitude").onchange = control("only").onchange = drawView;
  control("flight").onchange = chooseFlight;
  control("time").oninput = showTime;
  control("play").onclick = play;
  control("buildings").onchange = event => { stage.city.visible = event.target.checked; stage.redraw(); };
  control("devices").onchange = () => stage.redraw();
  for (const from of ["oblique", "above"]) control(from).onclick = () => stage.look(from);
  chooseView();
  chooseFlight();
  requestAnimationFrame(() => { document.body.dataset.readyMs = performance.now().toFixed(0); });
}

start();
