"use strict";
// The residual explorer: residuals of every dwell against a quantity of the bench, drawn by uPlot.
for (const root of document.querySelectorAll(".explorer")) explore(root);

function explore(root) {
  const run = JSON.parse(document.getElementById(root.dataset.content).textContent);
  const form = root.querySelector("form"), place = root.querySelector(".plot"), readout = root.querySelector(".readout");
  const welcome = readout.textContent, shapes = ["●", "■", "▲"];
  let plot = null, points = [], chosen = null;

  if (!run.drivers.length) {
    place.replaceWith("Nothing that was recorded varies in this run.");
    form.remove(); readout.remove();
    return;
  }
  run.drivers.forEach((each, k) => form.driver.add(
    new Option(each.shown ? each.shown + ", against " + each.name : each.name + (each.explains ? " (" + each.explains + ")" : ""), k)));
  form.unit.options[0].text = run.unit;
  run.models.forEach((each, k) => form.model.add(new Option(each.name, k)));
  for (let i = 0; i < 3; i++) {
    const box = Object.assign(document.createElement("input"), {type: "checkbox", checked: true, name: "a" + (i + 1)});
    const mark = Object.assign(document.createElement("b"), {textContent: " " + shapes[i] + " " + (i + 1)});
    const label = document.createElement("label");
    mark.style.color = "var(--a" + (i + 1) + ")";
    label.append(box, mark);
    form.querySelector("fieldset").append(label);
  }

  function ownUnit(driver) { return driver.shown_unit || run.unit; }

  function colour(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }

  function collect() {
    const driver = run.drivers[form.driver.value], model = run.models[form.model.value];
    const inSigma = form.unit.value === "sigma", found = [];
    for (let i = 0; i < 3; i++) if (form["a" + (i + 1)].checked) run.dwells.forEach((number, d) => {
      const sigma = (driver.sigma || run.sigma)[d][i], left = (driver.readings || model.residual)[d][i];
      const x = Array.isArray(driver.values[d]) ? driver.values[d][i] : driver.values[d];
      if (left == null || x == null || !(sigma > 0)) return;
      const fit = driver.component ? driver.component[d][i] : null, unit = inSigma ? sigma : 1;
      found.push({x, y: left / unit, bar: sigma / unit, fit: fit === null ? null : fit / unit, left, sigma, d, i});
    });
    return found.sort((one, other) => one.x - other.x);
  }

  function reach(values) {  // the range of an axis, with some room
    const low = Math.min(...values), high = Math.max(...values), room = 0.06 * (high - low || Math.abs(high) || 1);
    return [low - room, high + room];
  }

  function draw() {
    const driver = run.drivers[form.driver.value], inSigma = form.unit.value === "sigma";
    const ink = colour("--quiet"), line = colour("--line");
    points = collect(); chosen = null; readout.textContent = welcome;
    form.model.disabled = Boolean(driver.shown);
    form.unit.options[0].text = ownUnit(driver);
    for (let i = 1; i < 3; i++) form["a" + (i + 1)].disabled = Boolean(driver.channels) && i >= driver.channels.length;
    if (plot) plot.destroy();
    const axis = {values: (u, marks) => marks.map(each => each === null ? "" : number(each)), stroke: ink, grid: {stroke: line, width: 1}, ticks: {stroke: line}, font: "13px system-ui, sans-serif",
                  labelFont: "13px system-ui, sans-serif"};
    const xs = points.map(each => each.x), ys = points.map(each => each.y);
    const across = points.length ? reach(xs) : [0, 1];
    const along = points.length ? reach([...points.map(p => p.y - p.bar), ...points.map(p => p.y + p.bar), 0]) : [-1, 1];
    plot = new uPlot({
      width: Math.max(place.clientWidth - 8, 320), height: 410,
      scales: {x: {time: false, range: (u, low, high) => low === xs[0] && high === xs.at(-1) ? across : [low, high]}, y: {range: () => along}},
      legend: {show: false}, cursor: {points: {show: false}, drag: {x: true, y: false}},
      axes: [{...axis, label: driver.name + ", " + driver.unit, size: 46},
             {...axis, label: (driver.shown || "residual") + (inSigma ? " / σ" : ", " + ownUnit(driver)), size: 66}],
      series: [{}, {paths: () => null, points: {show: false}}],
      hooks: {draw: [paint], setCursor: [point]},
    }, [xs, ys], place);
  }

  function paint(u) {
    const c = u.ctx, box = u.bbox, dpr = window.devicePixelRatio || 1, many = points.length > 450;
    const colours = [1, 2, 3].map(i => colour("--a" + i));
    c.save();
    c.beginPath(); c.rect(box.left, box.top, box.width, box.height); c.clip();
    c.lineWidth = dpr; c.strokeStyle = colour("--quiet");
    const levels = form.unit.value === "sigma" ? [0, -2, 2] : [0];
    for (const level of levels) {
      const y = Math.round(u.valToPos(level, "y", true)) + 0.5;
      c.setLineDash(level ? [2 * dpr, 4 * dpr] : []);
      c.beginPath(); c.moveTo(box.left, y); c.lineTo(box.left + box.width, y); c.stroke();
    }
    c.setLineDash([]);
    for (const each of points) {
      const x = u.valToPos(each.x, "x", true), y = u.valToPos(each.y, "y", true);
      c.strokeStyle = c.fillStyle = colours[each.i];
      if (!many) {
        c.beginPath(); c.moveTo(x, u.valToPos(each.y - each.bar, "y", true));
        c.lineTo(x, u.valToPos(each.y + each.bar, "y", true)); c.stroke();
      }
      mark(c, each.i, x, y, (many ? 2 : 3.6) * dpr);
      if (each.fit !== null) {
        const fitted = u.valToPos(each.fit, "y", true);
        c.strokeStyle = colour("--text"); c.lineWidth = 2 * dpr;
        c.beginPath(); c.moveTo(x - 7 * dpr, fitted); c.lineTo(x + 7 * dpr, fitted); c.stroke();
        c.lineWidth = dpr;
      }
      if (each === chosen) { c.strokeStyle = colour("--text"); c.beginPath(); c.arc(x, y, 8 * dpr, 0, 7); c.stroke(); }
    }
    c.restore();
  }

  function mark(c, i, x, y, r) {
    c.beginPath();
    if (i === 0) c.arc(x, y, r, 0, 7);
    else if (i === 1) c.rect(x - r * 0.9, y - r * 0.9, 1.8 * r, 1.8 * r);
    else { c.moveTo(x, y - 1.2 * r); c.lineTo(x + 1.1 * r, y + 0.8 * r); c.lineTo(x - 1.1 * r, y + 0.8 * r); c.closePath(); }
    c.fill();
  }

  function point(u) {
    const {left, top} = u.cursor;
    let nearest = null, least = 30 * 30;
    if (left >= 0) for (const each of points) {
      const dx = u.valToPos(each.x, "x") - left, dy = u.valToPos(each.y, "y") - top;
      if (dx * dx + dy * dy < least) { least = dx * dx + dy * dy; nearest = each; }
    }
    if (nearest === chosen) return;
    chosen = nearest;
    tell(nearest);
    u.redraw(false);
  }

  function tell(each) {
    if (!each) { readout.textContent = welcome; return; }
    const driver = run.drivers[form.driver.value];
    const said = ["begun at " + number(run.begin_s[each.d]) + " s"];
    if (run.gimbals_deg) said.push("gimbals at " + run.gimbals_deg[each.d].map(a => number(a)).join(", ") + " deg");
    said.push(driver.name + " " + number(each.x) + " " + driver.unit);
    said.push((driver.shown || "residual") + " " + number(each.left) + " ± " + number(each.sigma) + " " + ownUnit(driver) + " (" + (each.left / each.sigma).toFixed(1) + " σ)");
    const head = document.createElement("strong");
    head.textContent = "Dwell " + run.dwells[each.d] + ", " + (driver.channels ? driver.channels[each.i] : "accelerometer " + (each.i + 1));
    readout.replaceChildren(head, ": " + said.join("; "));
  }

  function number(value) { return String(Number(value.toPrecision(4))).replace("-", "−"); }

  form.addEventListener("change", draw);
  form.addEventListener("submit", event => event.preventDefault());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  new ResizeObserver(() => plot && plot.setSize({width: Math.max(place.clientWidth - 8, 320), height: 410})).observe(place);
  draw();
}
