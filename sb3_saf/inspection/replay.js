"use strict";
// Plays the recording in the element "data". A recording has one or more runs of the same game; times t are game steps.

const data = JSON.parse(document.getElementById("data").textContent);
const runs = data.runs.map(unpackRun);
const last = Math.max(...runs.map((run) => run.steps));
const state = { t: 0, run: 0, agent: 0, playing: false };
const $ = (id) => document.getElementById(id);

// Okabe and Ito's colours, which colour-blind readers can tell apart.
const COLOURS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#999999"];
const ZONES = ["#ffffff", "#dcecf7", "#fbeed0", "#dff2ea", "#f6e4ee", "#fdf9d6", "#eeeeee"];
const colourOf = (agent) => COLOURS[agent % COLOURS.length];

// Arrays travel as base64 of little-endian numbers with their shape and scale.
function unpackArray(packed) {
  if (!packed) return null;
  const bytes = Uint8Array.from(atob(packed.data), (letter) => letter.charCodeAt(0));
  const kinds = { u1: Uint8Array, u2: Uint16Array, i2: Int16Array, f4: Float32Array };
  const numbers = new kinds[packed.type](bytes.buffer);
  const strides = packed.shape.map((_, i) => packed.shape.slice(i + 1).reduce((a, b) => a * b, 1));
  const at = (...index) => numbers[index.reduce((sum, i, k) => sum + i * strides[k], 0)] * packed.scale;
  return { shape: packed.shape, at };
}

function unpackRun(run) {
  const unpacked = { ...run };
  for (const [name, value] of Object.entries(run)) {
    if (value && value.type && value.data) unpacked[name] = unpackArray(value);
  }
  if (run.frames) {
    unpacked.images = run.frames.map((source) => Object.assign(new Image(), { src: source, onload: () => draw() }));
  }
  return unpacked;
}

const clamp = (t, run) => Math.min(t, run.steps);
const row = (t, run) => Math.min(t, run.steps - 1); // decisions exist for steps 0 .. T-1
const range = (n) => [...Array(n).keys()];
const show = (number, digits = 2) => (Number.isFinite(number) ? number.toFixed(digits) : "–");
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// --- stage ---------------------------------------------------------------------------------------------------------

function canvasOf(element, height) {
  const width = element.clientWidth || 300;
  const ratio = window.devicePixelRatio || 1;
  element.width = Math.round(width * ratio);
  element.height = Math.round(height(width) * ratio);
  const context = element.getContext("2d");
  context.scale(ratio, ratio);
  return { context, width, height: height(width) };
}

function collectedBy(run, t) {
  return run.collected ? run.collected.filter((when) => when >= 0 && when <= t).length : null;
}

function returnAt(run, t) {
  return range(clamp(t, run)).reduce((sum, i) => sum + run.rewards.at(i), 0);
}

function drawStage(run, element) {
  if (run.images) return drawFrame(run, element);
  const { width: w, height: h } = data.grid;
  const { context: c, width } = canvasOf(element, (x) => (x * h) / w);
  const s = width / w;
  const t = clamp(state.t, run);
  for (const x of range(w)) {
    c.fillStyle = ZONES[data.grid.zones[x] % ZONES.length];
    c.fillRect(x * s, 0, s + 1, width);
  }
  c.fillStyle = "#4a412a";
  for (const [x, y] of run.walls) c.fillRect(x * s, y * s, s + 0.5, s + 0.5);
  run.treasures.forEach(([x, y], i) => drawTreasure(c, x, y, s, run.collected[i] >= 0 && run.collected[i] <= t));
  for (const [x, y] of (run.keys && run.keys[t]) || []) drawKey(c, x, y, s);
  for (const agent of range(data.n_agents)) drawTrail(c, run, agent, t, s);
  for (const agent of range(data.n_agents)) drawAgent(c, run, agent, t, s);
}

function drawFrame(run, element) {
  const image = run.images[row(state.t, run)];
  if (!image.naturalWidth) return;
  const { context: c, width, height } = canvasOf(element, (x) => (x * image.naturalHeight) / image.naturalWidth);
  c.imageSmoothingEnabled = false;
  c.drawImage(image, 0, 0, width, height);
}

function drawTreasure(c, x, y, s, taken) {
  c.beginPath();
  c.moveTo((x + 0.5) * s, (y + 0.15) * s);
  c.lineTo((x + 0.85) * s, (y + 0.5) * s);
  c.lineTo((x + 0.5) * s, (y + 0.85) * s);
  c.lineTo((x + 0.15) * s, (y + 0.5) * s);
  c.closePath();
  c.fillStyle = taken ? "rgba(120,120,120,0.25)" : "#009e73";
  c.fill();
}

function drawKey(c, x, y, s) {
  c.fillStyle = "#b58900";
  c.font = `${s * 0.7}px sans-serif`;
  c.textAlign = "center";
  c.textBaseline = "middle";
  c.fillText("⚷", (x + 0.5) * s, (y + 0.5) * s);
}

function drawTrail(c, run, agent, t, s) {
  c.strokeStyle = colourOf(agent);
  c.globalAlpha = 0.35;
  c.lineWidth = s * 0.12;
  c.beginPath();
  for (let past = Math.max(0, t - 6); past <= t; past += 1) {
    c.lineTo((run.pose.at(past, agent, 0) + 0.5) * s, (run.pose.at(past, agent, 1) + 0.5) * s);
  }
  c.stroke();
  c.globalAlpha = 1;
}

function drawAgent(c, run, agent, t, s) {
  const [x, y, direction, key] = range(4).map((i) => run.pose.at(t, agent, i));
  c.save();
  c.translate((x + 0.5) * s, (y + 0.5) * s);
  c.rotate((direction * Math.PI) / 2);
  c.beginPath();
  c.moveTo(0.46 * s, 0);
  c.lineTo(-0.36 * s, 0.4 * s);
  c.lineTo(-0.36 * s, -0.4 * s);
  c.closePath();
  c.fillStyle = colourOf(agent);
  c.fill();
  c.lineWidth = agent === state.agent ? 2.5 : 1;
  c.strokeStyle = agent === state.agent ? "#000000" : "#ffffff";
  c.stroke();
  c.restore();
  label(c, String(agent), (x + 0.45) * s, (y + 0.5) * s, s * 0.5, "#000000");
  if (key) label(c, "⚷", (x + 0.85) * s, (y + 0.2) * s, s * 0.45, "#7a5c00");
  if (run.weights) label(c, String.fromCharCode(65 + favourite(run, t, agent)), (x + 0.95) * s, (y + 0.9) * s, s * 0.4, "#444444");
}

function label(c, text, x, y, size, colour) {
  c.fillStyle = colour;
  c.font = `600 ${Math.max(7, size)}px system-ui, sans-serif`;
  c.textAlign = "center";
  c.textBaseline = "middle";
  c.lineWidth = 2.5;
  c.strokeStyle = "rgba(255,255,255,0.85)";
  c.strokeText(text, x, y);
  c.fillText(text, x, y);
}

function favourite(run, t, agent) {
  const weights = range(run.weights.shape[2]).map((u) => run.weights.at(row(t, run), agent, u));
  return weights.indexOf(Math.max(...weights));
}

// --- panel of one agent ----------------------------------------------------------------------------------------------

function drawView(run) {
  $("own").hidden = !run.views;
  if (!run.views) return;
  const [, , height, width] = run.views.shape;
  const tile = data.tiles.shape[1];
  const element = $("view");
  element.width = width * tile;
  element.height = height * tile;
  const c = element.getContext("2d");
  const picture = c.createImageData(width * tile, height * tile);
  for (const y of range(height * tile)) {
    for (const x of range(width * tile)) {
      const code = run.views.at(row(state.t, run), state.agent, Math.floor(y / tile), Math.floor(x / tile));
      const place = 4 * (y * width * tile + x);
      for (const channel of range(3)) picture.data[place + channel] = tiles.at(code, y % tile, x % tile, channel);
      picture.data[place + 3] = 255;
    }
  }
  c.putImageData(picture, 0, 0);
}

function meterRows(labels, numbers, chosen, colours) {
  return labels
    .map((name, i) => {
      // Labels are ours or a game's names of actions: letters and digits only.
      const bar = `<span class="meter" style="width:${Math.round(90 * numbers[i])}px;${colours ? `background:${colours[i]}` : ""}"></span>`;
      return `<tr${i === chosen ? ' class="taken"' : ""}><td>${String(name).replace(/[^\w ]/g, "")}</td><td data-number="${numbers[i]}">${show(numbers[i])}</td><td>${bar}</td></tr>`;
    })
    .join("");
}

function drawActions(run) {
  $("choices").hidden = !run.probabilities;
  if (!run.probabilities) return;
  const t = row(state.t, run);
  const numbers = range(run.probabilities.shape[2]).map((a) => run.probabilities.at(t, state.agent, a));
  $("actions").innerHTML = meterRows(data.actions, numbers, run.actions.at(t, state.agent));
}

function drawPool(run) {
  $("pool").hidden = !run.weights;
  if (!run.weights) return;
  const t = row(state.t, run);
  const n = run.weights.shape[2];
  const names = range(n).map((u) => `policy ${String.fromCharCode(65 + u)}`);
  const numbers = range(n).map((u) => run.weights.at(t, state.agent, u));
  $("weights").innerHTML = meterRows(names, numbers, favourite(run, t, state.agent), COLOURS);
  const chart = newChart($("pool-chart"), run, 0, 1);
  const below = range(run.steps).map(() => 0);
  for (const u of range(n)) {
    const above = below.map((sum, i) => sum + run.weights.at(i, state.agent, u));
    chart.area(below, above, COLOURS[u]);
    above.forEach((sum, i) => (below[i] = sum));
  }
  chart.cursor();
}

function drawSource(run) {
  $("source").hidden = !run.read;
  if (!run.read) return;
  const t = row(state.t, run);
  const strength = run.message ? run.message.at(t, state.agent) : NaN;
  $("message").innerHTML = `Messages: without them, this agent's value changes by <b id="strength" data-number="${strength}">${show(strength, 3)}</b>.`;
  const slots = range(run.read.shape[2]);
  const numbers = slots.map((l) => run.read.at(t, state.agent, l));
  const heard = slots.map((l) => run.write.at(t, l, state.agent));
  $("slots").innerHTML =
    "<tr><th>slot</th><th>read by it</th><th></th><th>of what it heard, from this agent</th></tr>" +
    slots
      .map((l) => `<tr><td>${l + 1}</td><td data-number="${numbers[l]}">${show(numbers[l])}</td><td><span class="meter" style="width:${Math.round(90 * numbers[l])}px"></span></td><td>${show(heard[l])}</td></tr>`)
      .join("");
}

function drawCritic(run) {
  $("critic").hidden = !run.values;
  if (!run.values) return;
  const t = row(state.t, run);
  const value = run.values.at(t, state.agent);
  const came = run.returns.at(t, state.agent);
  const whose = run.of_team ? "The team's value" : "Value";
  $("value").innerHTML = `${whose} <b id="value-number" data-number="${value}">${show(value)}</b>, discounted return that came <b id="return-number" data-number="${came}">${show(came)}</b>`;
  lines($("value-chart"), run, [
    [range(run.steps).map((i) => run.values.at(i, state.agent)), colourOf(state.agent), "value"],
    [range(run.steps).map((i) => run.returns.at(i, state.agent)), css("--soft"), "return"],
  ]);
}

// --- the team --------------------------------------------------------------------------------------------------------

/** Return the agents that take part in step t. */
const agentsIn = (run, t) => range(data.n_agents).filter((i) => run.counted.at(t, i));

function drawTeam(run) {
  $("team").hidden = !run.values && !run.weights;
  if (run.values) {
    const mean = (array, t) => agentsIn(run, t).reduce((sum, i, _, { length }) => sum + array.at(t, i) / length, 0);
    const t = row(state.t, run);
    const without = run.message ? `; without messages the mean value changes by ${show(mean(run.message, t), 3)}` : "";
    $("team-value").textContent = `Mean value ${show(mean(run.values, t))}, mean return that came ${show(mean(run.returns, t))}${without} (${run.name})`;
    lines($("team-chart"), run, [
      [range(run.steps).map((i) => mean(run.values, i)), css("--mark"), "value"],
      [range(run.steps).map((i) => mean(run.returns, i)), css("--soft"), "return"],
    ]);
  }
  $("zones").innerHTML = run.weights ? zoneTable(run) : "";
}

function zoneTable(run) {
  const n = run.weights.shape[2];
  const zones = [...new Set(data.grid ? data.grid.zones : [0])];
  const sums = new Map(zones.map((zone) => [zone, { count: 0, weights: range(n).map(() => 0) }]));
  for (const t of range(run.steps)) {
    for (const agent of agentsIn(run, t)) {
      const entry = sums.get(data.grid ? data.grid.zones[run.pose.at(t, agent, 0)] : 0);
      entry.count += 1;
      for (const u of range(n)) entry.weights[u] += run.weights.at(t, agent, u);
    }
  }
  const head = range(n).map((u) => `<th>policy ${String.fromCharCode(65 + u)}</th>`).join("");
  const body = zones
    .map((zone) => {
      const { count, weights } = sums.get(zone);
      return `<tr><td>zone ${zone}</td>${weights.map((sum) => `<td>${show(count ? sum / count : NaN)}</td>`).join("")}</tr>`;
    })
    .join("");
  return `<h2>Use of the pool, by zone</h2><table><tr><th></th>${head}</tr>${body}</table>`;
}

// --- charts ----------------------------------------------------------------------------------------------------------

function newChart(element, run, low, high) {
  const { context: c, width, height } = canvasOf(element, () => 110);
  const x = (t) => 6 + ((width - 12) * t) / Math.max(1, last - 1);
  const y = (value) => height - 8 - ((height - 16) * (value - low)) / (high - low || 1);
  return {
    area(below, above, colour) {
      c.beginPath();
      above.forEach((value, t) => c.lineTo(x(t), y(value)));
      [...below.keys()].reverse().forEach((t) => c.lineTo(x(t), y(below[t])));
      c.closePath();
      c.fillStyle = colour;
      c.fill();
    },
    line(values, colour) {
      c.beginPath();
      values.forEach((value, t) => c.lineTo(x(t), y(value)));
      c.strokeStyle = colour;
      c.lineWidth = 1.8;
      c.stroke();
    },
    text(words, place, colour) {
      c.fillStyle = colour;
      c.font = "11px system-ui, sans-serif";
      c.textAlign = "right";
      c.fillText(words, width - 8, 14 + 13 * place);
    },
    cursor() {
      c.strokeStyle = css("--ink");
      c.lineWidth = 1;
      c.beginPath();
      c.moveTo(x(row(state.t, run)), 2);
      c.lineTo(x(row(state.t, run)), height - 2);
      c.stroke();
    },
  };
}

function lines(element, run, series) {
  const all = series.flatMap(([values]) => values);
  const chart = newChart(element, run, Math.min(0, ...all), Math.max(0.001, ...all));
  series.forEach(([values, colour, words], i) => {
    chart.line(values, colour);
    chart.text(words, i, colour);
  });
  chart.cursor();
}

// --- controls --------------------------------------------------------------------------------------------------------

function draw() {
  const run = runs[state.run];
  runs.forEach((each, i) => {
    drawStage(each, $(`stage-${i}`));
    const found = collectedBy(each, state.t);
    $(`score-${i}`).textContent = `${each.name}: return ${show(returnAt(each, state.t), 2)}${found === null ? "" : `, ${found} of ${each.treasures.length} treasures`}`;
  });
  $("time").value = state.t;
  $("clock").textContent = `step ${state.t} of ${last}`;
  [...$("agents").children].forEach((button) => button.setAttribute("aria-pressed", String(Number(button.dataset.agent) === state.agent)));
  drawView(run);
  drawActions(run);
  drawPool(run);
  drawSource(run);
  drawCritic(run);
  drawTeam(run);
}

function go(t) {
  state.t = Math.max(0, Math.min(last, t));
  draw();
}

function choose(agent, run = state.run) {
  state.agent = agent;
  state.run = run;
  draw();
}

let timer = null;
function play(playing) {
  state.playing = playing;
  $("play").textContent = playing ? "Pause" : "Play";
  clearInterval(timer);
  if (!playing) return;
  if (state.t >= last) state.t = 0;
  timer = setInterval(() => (state.t >= last ? play(false) : go(state.t + 1)), 1000 / Number($("speed").value));
}

function pointed(event, index) {
  const run = runs[index];
  if (!run.pose) return;
  const box = event.currentTarget.getBoundingClientRect();
  const x = ((event.clientX - box.left) / box.width) * data.grid.width - 0.5;
  const y = ((event.clientY - box.top) / box.height) * data.grid.height - 0.5;
  const t = clamp(state.t, run);
  const distance = (i) => Math.hypot(run.pose.at(t, i, 0) - x, run.pose.at(t, i, 1) - y);
  const nearest = range(data.n_agents).reduce((best, i) => (distance(i) < distance(best) ? i : best), 0);
  if (distance(nearest) < 1.2) choose(nearest, index);
}

const tiles = unpackArray(data.tiles);

function build() {
  runs.forEach((run, i) => {
    const figure = document.createElement("figure");
    figure.innerHTML = `<figcaption id="score-${i}"></figcaption><canvas id="stage-${i}" role="img"></canvas>`;
    $("stages").append(figure);
    $(`stage-${i}`).setAttribute("aria-label", `The game as played by ${run.name}`);
    $(`stage-${i}`).addEventListener("pointermove", (event) => pointed(event, i));
    $(`stage-${i}`).addEventListener("click", (event) => pointed(event, i));
    (run.collected || []).filter((when) => when >= 0).forEach((when) => {
      const mark = document.createElement("i");
      mark.style.left = `${(100 * when) / last}%`;
      $("marks").append(mark);
    });
  });
  for (const agent of range(data.n_agents)) {
    const button = document.createElement("button");
    button.textContent = data.agents[agent];
    button.dataset.agent = agent;
    button.style.borderBottom = `4px solid ${colourOf(agent)}`;
    button.setAttribute("aria-label", `Agent ${data.agents[agent]}`);
    button.addEventListener("click", () => choose(agent));
    $("agents").append(button);
  }
  if (runs.length > 1) {
    const pick = document.createElement("select");
    pick.setAttribute("aria-label", "Model");
    pick.append(...runs.map((run, i) => new Option(run.name, String(i))));
    pick.addEventListener("change", () => choose(state.agent, Number(pick.value)));
    $("agents").prepend(pick);
  }
  $("note").textContent = data.note;
  $("time").max = last;
  $("time").addEventListener("input", () => go(Number($("time").value)));
  $("play").addEventListener("click", () => play(!state.playing));
  $("back").addEventListener("click", () => go(state.t - 1));
  $("next").addEventListener("click", () => go(state.t + 1));
  $("speed").addEventListener("change", () => play(state.playing));
  document.addEventListener("keydown", (event) => {
    if (event.target.tagName === "SELECT") return;
    if (event.key === " ") play(!state.playing);
    else if (event.key === "ArrowRight") go(state.t + 1);
    else if (event.key === "ArrowLeft") go(state.t - 1);
    else if (/^[0-9]$/.test(event.key) && Number(event.key) < data.n_agents) choose(Number(event.key));
    else return;
    event.preventDefault();
  });
  window.addEventListener("resize", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
}

build();
