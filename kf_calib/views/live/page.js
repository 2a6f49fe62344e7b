"use strict";
// Asks for the state of the run twice a second, and shows it. All words come from the program: here they are only laid
// out, and the directions drawn on a map of the sphere (Mollweide's, which keeps areas; y is up, x in the middle).
const PERIOD_MS = 500, PATIENCE_MS = 3000, NUMBERED = 60, SVG = "http://www.w3.org/2000/svg";
let shown = null, run = null, heard = new Date(), over = false;

function of(id) { return document.getElementById(id); }

function made(tag, text, ...classes) {
  const node = Object.assign(document.createElement(tag), {textContent: text || ""});
  node.classList.add(...classes.flatMap(each => each.split(" ")).filter(Boolean));
  return node;
}

function write(id, text) { if (of(id).textContent !== text) of(id).textContent = text; }  // a screen reader says it once

function line(parts) {
  const paragraph = made("p");
  paragraph.append(...parts.map(([text, style]) => made("span", text, style)));
  return paragraph;
}

async function ask() {
  try {
    const answer = await fetch("state.json", {signal: AbortSignal.timeout(PATIENCE_MS)});
    if (!answer.ok) throw new Error(answer.status);
    const state = await answer.json();
    if (run && state.run !== run) location.reload();  // another run, perhaps of another version
    heard = new Date(); run = state.run; over = state.over;
    of("silence").hidden = true;
    document.body.className = "";
    if (state.task) show(state);
  } catch {
    if (!over) silence();
  }
  setTimeout(ask, over ? 20 * PERIOD_MS : PERIOD_MS);
}

function silence() {
  write("silence", "No answer from kf-calib since " + heard.toLocaleTimeString("en-GB") + ": it was ended or killed, or " +
        "the tunnel to it is closed. What stands below is the last that was known.");
  of("silence").hidden = false;
  document.body.className = "stale";
}

function show(state) {
  const before = shown && JSON.stringify(shown.directions);
  shown = state;
  document.title = state.task.what;
  of("task").className = state.task.colour;
  write("what", state.task.what); write("below", state.task.below);
  of("done").hidden = state.task.done === null;
  of("done").firstElementChild.style.width = 100 * state.task.done + "%";
  write("verdict", state.verdict ? state.verdict[0] : "");
  of("verdict").className = state.verdict ? state.verdict[1] : "";
  of("remarks").replaceChildren(...state.remarks.map(each => made("p", each, "yellow")),
                                ...state.doing ? [made("p", state.doing)] : []);
  of("following").hidden = !state.gimbals.length;
  of("gimbals").replaceChildren(...state.gimbals.map(([name, angle]) => {
    const pair = made("div");
    pair.append(made("dt", name), made("dd", angle + "°"));
    return pair;
  }));
  of("source").replaceChildren(...state.source.map(line));
  of("model").replaceChildren(...state.model.map(line));
  tabulate(state);
  of("key-disagrees").hidden = !state.directions.some(each => each.state === "disagrees");
  if (JSON.stringify(state.directions) !== before) draw();
}

function tabulate(state) {
  const head = made("tr"), bars = state.rows.map(row => row.bar).filter(Boolean);
  head.append(made("th"), ...state.headings.map(([name, side]) => made("th", name, side)), made("th"));
  document.querySelector("#sigmas thead").replaceChildren(head);
  document.querySelector("#sigmas tbody").replaceChildren(...state.rows.map(row => {
    const line = made("tr"), last = made("td");
    if (row.bar) last.append(drawn(row.bar));
    line.append(Object.assign(made("th", row.symbol), {scope: "row"}),
                ...row.cells.map((cell, k) => made("td", cell, state.headings[k][1])), last);
    return line;
  }));
  const aimed = bars.some(bar => bar.has_target), others = bars.some(bar => !bar.has_target);
  write("of-bars", [aimed ? "A blue bar is empty at the target and full at a thousand times the target." : "",
        others ? "A grey bar, without a target, is the longer the larger sigma is." : ""].join(" ").trim());
}

function drawn(bar) {
  if (bar.has_target && bar.share <= 0) return made("span", "✓ reached", "reached");
  const track = made("div", "", bar.has_target ? "bar aimed" : "bar"), fill = made("div");
  fill.style.width = 100 * Math.min(Math.max(bar.share, 0), 1) + "%";
  track.append(fill);
  return track;
}

function element(name, attributes, text) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  return node;
}

function draw() {
  const width = of("sphere").clientWidth, margin = 30, height = (width - 2 * margin) / 2 + 2 * margin;
  if (!shown || width < 100) return;
  const svg = element("svg", {viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label":
    shown.directions.filter(each => each.number !== null).length + " orientations on the sphere"});
  const a = width / 2 - margin, b = a / 2;
  const place = (longitude, latitude) => {
    let t = latitude;
    for (let k = 0; k < 30 && Math.abs(latitude) < 1.5707; k++)
      t -= (2 * t + Math.sin(2 * t) - Math.PI * Math.sin(latitude)) / (2 + 2 * Math.cos(2 * t));
    return [width / 2 + a * longitude / Math.PI * Math.cos(t), height / 2 - b * Math.sin(t)];
  };
  const on = up => place(Math.atan2(-up[2], up[0]), Math.asin(Math.min(Math.max(up[1], -1), 1)));
  svg.append(element("ellipse", {class: "globe", cx: width / 2, cy: height / 2, rx: a, ry: b}));
  for (let k = -2; k <= 2; k++) {
    const latitude = k * Math.PI / 6, [left, y] = place(-Math.PI, latitude), [right] = place(Math.PI, latitude);
    svg.append(element("path", {class: "grid", d: `M${left} ${y}H${right}`}));
    svg.append(element("ellipse", {class: "grid", cx: width / 2, cy: height / 2, rx: a * Math.abs(k) / 3, ry: b}));
  }
  for (const [name, longitude, latitude, right, up] of [["+x", 0, 0, 0, 0], ["+z", -Math.PI / 2, 0, 0, 0], ["−z", Math.PI / 2, 0, 0, 0],
    ["−x", Math.PI, 0, 17, 0], ["−x", -Math.PI, 0, -17, 0], ["+y", 0, Math.PI / 2, 0, -21], ["−y", 0, -Math.PI / 2, 0, 21]]) {
    const [x, y] = place(longitude, latitude);
    svg.append(element("text", {class: "axis", x: x + right, y: y + up}, name));
  }
  const here = shown.directions.find(each => each.state === "here"), next = shown.directions.find(each => each.state === "next");
  if (here && next) svg.append(...way(here.up, next.up).map(each => {
    const points = each.map(on);
    return element("path", {class: "way", d: "M" + points.map(([x, y]) => x.toFixed(1) + " " + y.toFixed(1)).join("L")});
  }));
  const few = shown.directions.length <= NUMBERED, size = few ? (width > 560 ? 13 : 10) : 5;
  for (const each of shown.directions) {
    const [x, y] = on(each.up), square = each.state === "disagrees";
    svg.append(square ? element("rect", {class: each.state, x: x - size, y: y - size, width: 2 * size, height: 2 * size}) :
               element("circle", {class: each.state, cx: x, cy: y, r: each.state === "done" ? size : size + 3}));
    if (few && each.number !== null)
      svg.append(element("text", {class: "number " + each.state, x, y, "font-size": each.number > 99 ? size - 1 : size}, each.number));
  }
  of("sphere").replaceChildren(svg);
}

// The shortest way between two directions, in pieces that do not cross the seam of the map (opposite +x).
function way(start, end) {
  const pieces = [[]];
  let before = null;
  for (let k = 0; k <= 48; k++) {
    const s = k / 48, sum = start.map((each, i) => (1 - s) * each + s * end[i]), size = Math.hypot(...sum) || 1;
    const point = sum.map(each => each / size);
    if (before && point[0] < 0 && point[2] * before[2] < 0) pieces.push([]);
    pieces[pieces.length - 1].push(point);
    before = point;
  }
  return pieces.filter(each => each.length > 1);
}

// A phone beside the table stays awake while the page is seen, where its browser can do that.
async function stayAwake() {
  try { if (document.visibilityState === "visible") await navigator.wakeLock?.request("screen"); } catch { /* it may not */ }
}

document.addEventListener("visibilitychange", stayAwake);
new ResizeObserver(draw).observe(of("sphere"));
stayAwake();
ask();
