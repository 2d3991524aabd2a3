"use strict";
// Pixels are those of the survey: the centre of the first one is at 0.5, 0.5.

const TILE = {tile_px}, MOST_TILES = 300, DRAG_PX = 4, MOST_SCALE = 32, LENS_SCALE = 4, LENS_PX = 80;
const COLOURS = { ground: "#ffd60a", water: "#4cc9f0", predicted: "#ff5db1", proposed: "#7bf1a8", dry: "#ff9f1c", wet: "#4cc9f0" };
const token = new URLSearchParams(location.search).get("token") || "";
const $ = (id) => document.getElementById(id);
const canvas = $("canvas"), context = canvas.getContext("2d");

let state = null;      // of the server
let chosen = null;     // {kind, name} of the point that clicks mark
let photograph = null; // name of the one that is shown
let look = { predicted: null, curves: [], next: [], others: [] };
let view = { scale: 1, x: 0, y: 0 }; // canvas pixels per image pixel; the image pixel at the upper left corner
let visited = [];
let asked = 0;
let proposed = {};     // {pixel, score} of the chosen point, by photograph
let corners = null;    // of the polygon that is drawn, [] before its first; null: clicks set marks
let leftOut = null;    // what the mask leaves out of the photograph
let cursor = null;     // [x, y] on the canvas
const tiles = new Map();

// ---- the server -------------------------------------------------------------------------------------------------

async function ask(path, body) {
  const options = { headers: { "X-Bathynerf-Token": token } };
  if (body !== undefined) Object.assign(options, { method: "POST", body: JSON.stringify(body) });
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Error("the server does not answer: is bathynerf mark still running?");
  }
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

// One change after another, in the order of the clicks.
let queue = Promise.resolve();
function change(path, body) {
  queue = queue.then(async () => {
    try {
      state = await (await ask(path, body)).json();
      say(path === "/add" ? "" : "saved");
    } catch (error) {
      say(error.message, true);
    }
    await refresh();
  });
  return queue;
}

async function refresh() {
  const mine = ++asked;
  lists();
  draw();
  if (!chosen || !photograph) return;
  const query = new URLSearchParams({ ...chosen, image: photograph });
  try {
    const found = await (await ask(`/look?${query}`)).json();
    if (mine !== asked) return;
    look = found;
    warm(look.next.find((name) => name !== photograph));
  } catch (error) {
    say(error.message, true);
  }
  lists();
  draw();
}

function say(text, isBad) {
  $("message").textContent = text;
  $("message").className = isBad ? "bad" : "";
}

// ---- points and photographs -------------------------------------------------------------------------------------

const isSame = (a, b) => a && b && a.kind === b.kind && a.name === b.name;
const pointOf = (key) => state.points.find((point) => isSame(point, key));
const sizeOf = (name) => state.photographs.find((each) => each.name === name).size;

function choose(key) {
  if (!isSame(key, chosen)) proposed = {};
  chosen = { kind: key.kind, name: key.name };
  return refresh().then(() => {
    const point = pointOf(chosen);
    const at = photograph in point.marks ? point.marks[photograph] : look.predicted;
    if (at) centre(at);
    // A spot that is new is in this photograph, or it would not be added now.
    const [elsewhere] = [...Object.keys(point.marks), ...(point.place ? look.next : [])];
    return at || !elsewhere ? undefined : open(elsewhere);
  });
}

async function open(name, isBack) {
  if (!isBack && photograph && photograph !== name) visited.push(photograph);
  const isFirst = photograph === null;
  photograph = name;
  leftOut = null;
  if (corners) corners = [];
  look = { predicted: null, curves: [], next: look.next, others: [] };
  if (isFirst) fit();
  await Promise.all([refresh(), readMask()]);
  const point = chosen && pointOf(chosen);
  const at = point && (point.marks[name] || look.predicted);
  if (at) centre(at);
}

function next() {
  const [first] = look.next.filter((name) => name !== photograph);
  if (first) return open(first);
  const names = state.photographs.map((each) => each.name);
  return open(names[(names.indexOf(photograph) + 1) % names.length]);
}

function previous() {
  if (visited.length) open(visited.pop(), true);
}

function mark(pixel, more) {
  if (!chosen) return say("choose a point, or add one, before you click", true);
  delete proposed[photograph];
  return change("/mark", { ...chosen, image: photograph, pixel, ...more });
}

async function propose() {
  if (!chosen) return say("choose a point before others like it are looked for", true);
  say("looking for the point in other photographs ...");
  const key = chosen;
  try {
    const found = await (await ask(`/propose?${new URLSearchParams(key)}`)).json();
    if (!isSame(key, chosen)) return undefined;
    proposed = Object.fromEntries(found.map((each) => [each.image, each]));
    say(found.length ? "Enter: accept the one in this photograph" : "nothing like it was found; mark it in one more photograph");
    if (found.length) await open(found[0].image);
  } catch (error) {
    say(error.message, true);
  }
  return undefined;
}

async function accept() {
  if (!(photograph in proposed)) return;
  await mark(proposed[photograph].pixel);
  const [more] = Object.keys(proposed);
  if (more) await open(more);
}

function acceptAll() {
  for (const { image, pixel } of Object.values(proposed)) change("/mark", { ...chosen, image, pixel });
  proposed = {};
  return queue;
}

// ---- masks ------------------------------------------------------------------------------------------------------

function drawMask(isOn) {
  corners = isOn ? [] : null;
  $("mask").className = isOn ? "on" : "";
  say(isOn ? "click the corners; Enter: leave it out, Shift + Enter: use it again, Backspace: last corner, m: end" : "");
  draw();
}

function lastCorner() {
  corners.pop();
  draw();
}

async function closeMask(isUsed) {
  if (corners.length < 3) return say("a part to leave out has three corners or more", true);
  const drawn = corners;
  await change("/mask", { image: photograph, corners: drawn, is_used: isUsed });
  // Of a polygon that was refused the corners stay; the message says why.
  if (corners === drawn && !$("message").className) corners = [];
  return readMask();
}

async function readMask() {
  const name = photograph;
  try {
    const mask = await createImageBitmap(await (await ask(`/mask/${encodeURIComponent(name)}`)).blob());
    const tinted = new OffscreenCanvas(Math.min(mask.width, 2048), Math.min(mask.height, 2048)), on = tinted.getContext("2d");
    on.drawImage(mask, 0, 0, tinted.width, tinted.height);
    const pixels = on.getImageData(0, 0, tinted.width, tinted.height);
    for (let i = 0; i < pixels.data.length; i += 4) pixels.data.set([220, 40, 40, pixels.data[i] ? 0 : 128], i);
    on.putImageData(pixels, 0, 0);
    if (name === photograph) leftOut = tinted;
  } catch (error) {
    say(error.message, true);
  }
  draw();
}

async function undo() {
  await change("/undo", {});
  if (!state.undone) return;
  chosen = { kind: state.undone.kind, name: state.undone.name };
  await open(state.undone.image);
}

function addWater() {
  const names = new Set(state.points.filter((point) => point.kind === "water").map((point) => point.name));
  let number = 1;
  while (names.has(`w${number}`)) number += 1;
  const key = { kind: "water", name: `w${number}` };
  return change("/add", key).then(() => pointOf(key) && choose(key));
}

function addControl(event) {
  event.preventDefault();
  const form = event.target, key = { kind: "ground", name: form.name.value.trim() };
  const place = form.place.value.trim().split(/[\s,;]+/).map(Number);
  return change("/add", { ...key, place }).then(() => {
    if (!pointOf(key)) return undefined;
    form.reset();
    form.hidden = true;
    return choose(key);
  });
}

// ---- lists ------------------------------------------------------------------------------------------------------

const length = (values) => Math.hypot(...values);
const axes = () => [...(state.is_geographic ? ["longitude", "latitude"] : ["easting", "northing"]), "height"];
const metres = (values) => values.map((value) => value.toFixed(3).replace("-", "\u2212")).join("  ");

function rms(point) {
  const found = Object.values(point.residuals).map(length);
  return found.length ? Math.sqrt(found.reduce((sum, value) => sum + value * value, 0) / found.length) : null;
}

function row(list, text, value, isChosen, isBad, onclick, title) {
  const item = document.createElement("li"), left = document.createElement("span"), right = document.createElement("span");
  left.textContent = text;
  right.textContent = value;
  right.className = isBad ? "value bad" : "value";
  item.className = isChosen ? "chosen" : "";
  item.title = title || text;
  item.onclick = onclick;
  item.append(left, right);
  list.append(item);
}

function lists() {
  $("survey").textContent = state.name;
  $("new-point").place.placeholder = axes().join(", ");
  $("undo").disabled = !state.can_undo;
  $("previous").disabled = !visited.length;
  if ($("photograph").options.length !== state.photographs.length) {
    $("photograph").replaceChildren(...state.photographs.map(({ name }) => new Option(name, name)));
  }
  $("photograph").value = photograph;
  $("points").replaceChildren();
  for (const point of state.points) {
    const count = Object.keys(point.marks).length, error = rms(point);
    const sign = point.kind === "water" ? "≈ " : point.check ? "◇ " : "◆ ";
    const value = `${count}${error === null ? "" : ` · ${error.toFixed(2)} px`}`;
    const title = point.kind === "water" ? "point of the waterline" : point.check ? "check point" : "control point";
    row($("points"), sign + point.name, value, isSame(point, chosen), error > point.limit_px, () => choose(point), title);
  }
  $("points").querySelector(".chosen")?.scrollIntoView({ block: "nearest" });
  $("marks").replaceChildren();
  $("candidates").replaceChildren();
  $("proposed").replaceChildren();
  $("proposals").hidden = !Object.keys(proposed).length;
  for (const { image, score } of Object.values(proposed)) row($("proposed"), image, score.toFixed(2), image === photograph, false, () => open(image));
  const point = chosen && pointOf(chosen);
  if (point) {
    for (const name of Object.keys(point.marks)) {
      const of = point.residuals[name] || null, error = of && length(of);
      row($("marks"), name, error === null ? "" : `${error.toFixed(2)} px`, name === photograph, error > point.limit_px, () => open(name));
    }
    for (const name of look.next) row($("candidates"), name, "", name === photograph, false, () => open(name));
  }
  detail(point);
  $("notes").replaceChildren(...[
    state.poses ? `Poses: ${state.poses}.` : "", ...state.notes,
    ...state.settings.map((line) => `For process, in survey.toml: ${line}`),
  ].filter(Boolean).map((text) => Object.assign(document.createElement("p"), { textContent: text })));
}

function detail(point) {
  const rows = [];
  // Degrees to a millimetre on the ground.
  const digits = state.is_geographic ? [8, 8, 3] : [3, 3, 3];
  if (point && point.place) axes().forEach((axis, i) => rows.push([axis, point.place[i].toFixed(digits[i])]));
  if (point && point.depth_m) rows.push(["depth", `${point.depth_m.toFixed(2)} m`]);
  if (point && point.level !== null) rows.push(["level", `${point.level.toFixed(3)} m`]);
  if (point && point.std_m) rows.push(["std [m]", metres(point.std_m)]);
  if (point && point.off_m) rows.push(["error [m]", metres(point.off_m)]);
  const list = document.createElement("dl");
  for (const pair of rows) {
    const [label, value] = ["dt", "dd"].map((tag) => document.createElement(tag));
    [label.textContent, value.textContent] = pair;
    list.append(label, value);
  }
  $("detail").replaceChildren(list);
}

// ---- the photograph ---------------------------------------------------------------------------------------------

const toImage = (x, y) => [view.x + x / view.scale, view.y + y / view.scale];
const toCanvas = ([x, y]) => [(x - view.x) * view.scale, (y - view.y) * view.scale];
const canvasSize = () => [canvas.clientWidth, canvas.clientHeight];

function fit() {
  const [width, height] = sizeOf(photograph), [w, h] = canvasSize();
  view.scale = Math.min(w / width, h / height);
  view.x = 0.5 * (width - w / view.scale);
  view.y = 0.5 * (height - h / view.scale);
  draw();
}

function centre([x, y]) {
  const [w, h] = canvasSize();
  view.scale = Math.max(view.scale, 1);
  view.x = x - (0.5 * w) / view.scale;
  view.y = y - (0.5 * h) / view.scale;
  draw();
}

function zoom(factor, x, y) {
  const [u, v] = toImage(x, y);
  view.scale = Math.min(Math.max(view.scale * factor, 0.01), MOST_SCALE);
  view.x = u - x / view.scale;
  view.y = v - y / view.scale;
  draw();
}

function tile(name, level, column, line) {
  const path = `/tile/${level}/${column}/${line}/${encodeURIComponent(name)}`;
  const found = tiles.get(path);
  if (found !== undefined) {
    tiles.delete(path);
    tiles.set(path, found);
    return found;
  }
  tiles.set(path, null);
  ask(path).then((answer) => answer.blob()).then(createImageBitmap).then((bitmap) => {
    tiles.set(path, bitmap);
    for (const [old, image] of tiles) {
      if (tiles.size <= MOST_TILES) break;
      if (image) image.close();
      tiles.delete(old);
    }
    draw();
  }).catch((error) => { tiles.delete(path); say(error.message, true); });
  return null;
}

function coarsestOf(width, height) {
  let level = 0;
  while (Math.max(width, height) / 2 ** level > TILE) level += 1;
  return level;
}

// Decoded by the time that it is opened.
function warm(name) {
  if (name) tile(name, coarsestOf(...sizeOf(name)), 0, 0);
}

function drawLevel(level, width, height) {
  const span = TILE * 2 ** level, [w, h] = canvasSize();
  const [left, top] = toImage(0, 0), [right, bottom] = toImage(w, h);
  for (let line = Math.max(0, Math.floor(top / span)); line * span < Math.min(bottom, height); line += 1) {
    for (let column = Math.max(0, Math.floor(left / span)); column * span < Math.min(right, width); column += 1) {
      const image = tile(photograph, level, column, line);
      if (!image) continue;
      const [x, y] = toCanvas([column * span, line * span]), size = 2 ** level * view.scale;
      context.drawImage(image, x, y, image.width * size, image.height * size);
    }
  }
}

let isWaiting = false;
function draw() {
  if (isWaiting) return;
  isWaiting = true;
  requestAnimationFrame(() => { isWaiting = false; paint(); });
}

function paint() {
  const [w, h] = canvasSize(), ratio = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
  }
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, w, h);
  if (!photograph) return;
  scene(ratio);
  magnify(ratio);
}

// What is at the cursor, larger, beside it.
function magnify(ratio) {
  if (!cursor || (held && held.isDrag) || view.scale >= LENS_SCALE) return;
  const kept = { ...view }, [w, h] = canvasSize(), [u, v] = toImage(...cursor);
  const [x, y] = cursor.map((at, i) => at + (at + 2.6 * LENS_PX > [w, h][i] ? -1.5 : 1.5) * LENS_PX);
  Object.assign(view, { scale: LENS_SCALE, x: u - x / LENS_SCALE, y: v - y / LENS_SCALE });
  context.save();
  context.beginPath();
  context.arc(x, y, LENS_PX, 0, 2 * Math.PI);
  context.clip();
  context.clearRect(0, 0, w, h);
  scene(ratio);
  cross([u, v], "#fff", 20, "", 0.9);
  context.restore();
  Object.assign(view, kept);
  context.beginPath();
  context.arc(x, y, LENS_PX, 0, 2 * Math.PI);
  context.strokeStyle = "#fff";
  context.lineWidth = 2;
  context.stroke();
}

function scene(ratio) {
  const [width, height] = sizeOf(photograph);
  const coarsest = coarsestOf(width, height);
  const level = Math.min(Math.max(Math.floor(Math.log2(1 / (view.scale * ratio))), 0), coarsest);
  context.imageSmoothingEnabled = view.scale < 3;
  if (level !== coarsest) drawLevel(coarsest, width, height);
  drawLevel(level, width, height);
  if (leftOut) context.drawImage(leftOut, ...toCanvas([0, 0]), width * view.scale, height * view.scale);
  if (corners && corners.length) {
    line([...corners, corners[0]], "#dc2828");
    for (const at of corners) cross(at, "#dc2828", 5, "", 1);
  }
  if (photograph in proposed) cross(proposed[photograph].pixel, COLOURS.proposed, 14, "Enter", 1);
  for (const curve of look.curves) {
    line(curve.dry, COLOURS.dry);
    line(curve.wet, COLOURS.wet);
  }
  for (const other of look.others || []) cross(other.pixel, COLOURS.predicted, 4, other.name, 0.6);
  if (look.predicted) circle(look.predicted, COLOURS.predicted);
  for (const point of state.points) {
    const at = point.marks[photograph], isChosen = isSame(point, chosen);
    if (!at) continue;
    const of = point.residuals[photograph];
    cross(at, COLOURS[point.kind], isChosen ? 12 : 7, point.name, 1);
    if (of) line([at, [at[0] - of[0], at[1] - of[1]]], COLOURS.predicted);
  }
}

function line(pixels, colour) {
  context.beginPath();
  pixels.forEach((pixel, i) => context[i ? "lineTo" : "moveTo"](...toCanvas(pixel)));
  context.strokeStyle = colour;
  context.lineWidth = 1.5;
  context.stroke();
}

function circle(pixel, colour) {
  const [x, y] = toCanvas(pixel);
  context.beginPath();
  context.setLineDash([4, 3]);
  context.arc(x, y, 16, 0, 2 * Math.PI);
  context.strokeStyle = colour;
  context.lineWidth = 2;
  context.stroke();
  context.setLineDash([]);
  cross(pixel, colour, 4, "", 1);
}

// Open in the middle, so that it hides nothing of what is marked.
function cross(pixel, colour, reach, name, alpha) {
  const [x, y] = toCanvas(pixel);
  context.globalAlpha = alpha;
  for (const [style, thickness] of [["rgba(0,0,0,.65)", 3.5], [colour, 1.5]]) {
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + 2.5 * dx, y + 2.5 * dy);
      context.lineTo(x + reach * dx, y + reach * dy);
    }
    context.strokeStyle = style;
    context.lineWidth = thickness;
    context.stroke();
  }
  context.font = "12px system-ui, sans-serif";
  context.lineWidth = 3;
  context.strokeStyle = "rgba(0,0,0,.65)";
  context.strokeText(name, x + reach + 3, y - 5);
  context.fillStyle = colour;
  context.fillText(name, x + reach + 3, y - 5);
  context.globalAlpha = 1;
}

// ---- mouse and keys ---------------------------------------------------------------------------------------------

let held = null;
canvas.onpointerdown = (event) => {
  if (event.button > 1) return;
  held = { x: event.offsetX, y: event.offsetY, from: { ...view }, isDrag: event.button === 1 };
  canvas.setPointerCapture(event.pointerId);
};
canvas.onpointermove = (event) => {
  cursor = [event.offsetX, event.offsetY];
  draw();
  if (photograph) $("cursor").textContent = `${toImage(event.offsetX, event.offsetY).map((v) => v.toFixed(1)).join(", ")} px · ${(100 * view.scale).toFixed(0)} %`;
  if (!held) return;
  const [dx, dy] = [event.offsetX - held.x, event.offsetY - held.y];
  held.isDrag ||= Math.hypot(dx, dy) > DRAG_PX;
  if (!held.isDrag) return;
  view.x = held.from.x - dx / view.scale;
  view.y = held.from.y - dy / view.scale;
  draw();
};
canvas.onpointerup = () => {
  const was = held;
  held = null;
  if (!was || was.isDrag || !photograph) return;
  const [x, y] = toImage(was.x, was.y), [width, height] = sizeOf(photograph);
  if (!(x >= 0 && y >= 0 && x <= width && y <= height)) return;
  if (!corners) mark([x, y]);
  else corners.push([x, y]);
  draw();
};
canvas.onpointerleave = () => { cursor = null; draw(); };
canvas.onpointercancel = () => { held = null; };
canvas.onwheel = (event) => {
  event.preventDefault();
  zoom(Math.exp(-0.0015 * event.deltaY), event.offsetX, event.offsetY);
};

// To the corner of a chequered target.
function toCorner() {
  const point = chosen && pointOf(chosen), at = point && point.marks[photograph];
  if (at) mark(at, { corner: true });
}

function nudge(dx, dy) {
  const point = chosen && pointOf(chosen), at = point && point.marks[photograph];
  if (at) mark([at[0] + dx / view.scale, at[1] + dy / view.scale]);
}

const KEYS = {
  n: next, p: previous, u: () => (corners ? lastCorner() : undo()), 0: fit, 1: () => zoomTo(1), "+": () => zoomTo(2 * view.scale), "-": () => zoomTo(0.5 * view.scale),
  Delete: () => mark(null), Backspace: () => (corners ? lastCorner() : mark(null)),
  s: propose, c: toCorner, m: () => drawMask(!corners), Enter: (event) => (corners ? closeMask(event.shiftKey) : accept()),
  ArrowLeft: () => nudge(-1, 0), ArrowRight: () => nudge(1, 0), ArrowUp: () => nudge(0, -1), ArrowDown: () => nudge(0, 1),
};
const zoomTo = (scale) => zoom(scale / view.scale, ...canvasSize().map((size) => 0.5 * size));
document.onkeydown = (event) => {
  if (["INPUT", "SELECT"].includes(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
  const does = KEYS[event.key];
  if (!does) return;
  event.preventDefault();
  does(event);
};

$("next").onclick = next;
$("previous").onclick = previous;
$("undo").onclick = undo;
$("fit").onclick = fit;
$("propose").onclick = propose;
$("accept-all").onclick = acceptAll;
$("mask").onclick = (event) => { event.target.blur(); drawMask(!corners); };
$("whole").onclick = () => zoomTo(1);
$("add-water").onclick = addWater;
$("add-control").onclick = () => { $("new-point").hidden = !$("new-point").hidden; };
$("new-point").onsubmit = addControl;
$("photograph").onchange = (event) => { open(event.target.value); canvas.focus(); };
window.onresize = draw;

// Where on the page a pixel of the photograph is, for scripts.
window.pageOf = (pixel) => {
  const box = canvas.getBoundingClientRect(), [x, y] = toCanvas(pixel);
  return [box.x + x, box.y + y];
};

(async () => {
  try {
    state = await (await ask("/state")).json();
  } catch (error) {
    return say(error.message, true);
  }
  await open(state.photographs[0].name);
  const [first] = state.points;
  if (first) await choose(first);
  say("choose a point at the left and click it; n: next photograph, s: propose, wheel: zoom, u: undo");
  document.body.dataset.ready = "1";
  return undefined;
})();
