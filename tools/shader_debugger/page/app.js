// The page of `blinkgl shader serve`. All numbers come from the server as the command line prints them; this file only
// asks, draws and remembers (in the address: what is shown can be bookmarked).
"use strict";

const $ = (id) => document.getElementById(id);
const SETTINGS = ["view", "a", "b", "component", "map", "low", "high"];
let state = null;   // what /state said
let pixel = null;   // [x, y] or null
let busy = false;   // one request at a time: scrubbing skips what it cannot keep up with
let wanted = false;

async function get(path, query = {}) {
  const answer = await fetch(path + "?" + new URLSearchParams(query));
  if (!answer.ok) throw new Error((await answer.json()).error);
  return answer;
}

// ---- what is shown ----------------------------------------------------------------------------------------------

function settings() {
  const s = Object.fromEntries(SETTINGS.map((id) => [id, $(id).value]));
  return { ...s, t: $("seconds").value };
}

function remember() {
  const s = settings();
  if (pixel) [s.x, s.y] = pixel;
  history.replaceState(null, "", "#" + new URLSearchParams(s));
}

function recall() {
  const s = new URLSearchParams(location.hash.slice(1));
  for (const id of SETTINGS) if (s.has(id)) $(id).value = s.get(id);
  for (const id of ["a", "b"]) if (!$(id).value) $(id).selectedIndex = 0;
  setTime(Number(s.get("t") || state.t));
  if (s.has("x")) pixel = [Number(s.get("x")), Number(s.get("y"))];
}

function setTime(t) {
  t = Math.min(Math.max(t, state.t0), state.t1);
  $("seconds").value = String(Math.round(t * 1e9) / 1e9);
  $("time").value = t;
}

function caption(which, text) {
  const [name, source] = text.split(":");
  const pass = state.passes.find((p) => p.name === name);
  const head = $("pane-" + which).querySelector("figcaption");
  head.children[0].textContent = pass.title + (source === "reference" ? " — float64 reference" : " — GPU");
  head.children[1].textContent = pass.unit + (source === "reference" ? "" : " · " + pass.source);
}

// ---- pictures ---------------------------------------------------------------------------------------------------

async function show(which, path, query) {
  const answer = await get(path, query);
  const legend = JSON.parse(answer.headers.get("X-Legend"));
  const pane = $("pane-" + which), image = pane.querySelector("img");
  const url = URL.createObjectURL(await answer.blob());
  await new Promise((done) => { image.onload = image.onerror = done; image.src = url; });
  URL.revokeObjectURL(url);
  drawLegend(pane.querySelector(".legend"), legend);
  return legend;
}

// The colour bars are sampled from matplotlib's maps: enough stops for the eye.
const STOPS = {
  viridis: "440154 482878 3e4989 31688e 26828e 1f9e89 35b779 6ece58 b5de2b fde725",
  turbo: "30123b 4662d7 36aaf9 1ae4b6 72fe5e c8ef34 faba39 f66b19 cb2a04 7a0403",
  inferno: "000004 1b0c41 4a0c6b 781c6d a52c60 cf4446 ed6925 fb9b06 f7d13d fcffa4",
  gray: "000000 ffffff",
  RdBu_r: "053061 2f79b5 6bacd1 bfdceb f7f6f6 fac8af e17860 b31b2c 67001f",
  coolwarm: "3b4cc0 6788ee 9abbff c9d7f0 edd1c2 f7a889 e26952 b40426",
};

function drawLegend(box, legend) {
  const [canvas, low, text, high] = ["canvas", ".low", ".text", ".high"].map((s) => box.querySelector(s));
  const number = (v) => String(Number(v.toPrecision(4)));
  canvas.hidden = legend.kind !== "bar";
  low.textContent = legend.kind === "bar" ? number(legend.low) : "";
  high.textContent = legend.kind === "bar" ? number(legend.high) : "";
  text.textContent = {
    bar: legend.unit + (legend.log ? ", logarithmic" : ""), mask: "white: yes, black: no", ids: "one colour per number",
    unit: "r, g, b = x, y, z; grey is 0", uv: "r, g = fractional part of u, v", light: "sRGB, white = " + number(legend.high || 1),
    wheel: "hue: direction (+x red, +y yellow, −x blue, −y violet), saturated at " + number(legend.high || 0) + " " + legend.unit,
  }[legend.kind] || "";
  if (legend.kind !== "bar") return;
  const context = canvas.getContext("2d"), stops = STOPS[legend.map].split(" ");
  const fill = context.createLinearGradient(0, 0, canvas.width, 0);
  stops.forEach((c, i) => fill.addColorStop(i / (stops.length - 1), "#" + c));
  context.fillStyle = fill;
  context.fillRect(0, 0, canvas.width, 1);
}

async function refresh() {
  wanted = true;
  if (busy) return;
  busy = true;
  while (wanted) {
    wanted = false;
    const s = settings();
    const common = { t: s.t, component: s.component, map: s.map, low: s.low, high: s.high };
    if (s.t !== compared) forget();
    $("pane-b").hidden = s.view === "single";
    document.querySelector(".second").hidden = s.view === "single";
    remember();
    try {
      const [pa, sa] = s.a.split(":"), [pb, sb] = s.b.split(":");
      caption("a", s.a);
      const legend = await show("a", "image", { ...common, pass: pa, source: sa });
      if (s.view === "side") {
        caption("b", s.b);
        const same = pa === pb && (legend.kind === "bar" || legend.kind === "wheel"); // one scale for both
        await show("b", "image", { ...common, ...(same ? { low: s.low || legend.low || "", high: s.high || legend.high } : {}), pass: pb, source: sb });
      } else if (s.view === "difference") {
        const head = $("pane-b").querySelector("figcaption");
        head.children[0].textContent = "|A − B|";
        head.children[1].textContent = s.a.replace(":", ", ") + " − " + s.b.replace(":", ", ");
        await show("b", "difference", { t: s.t, component: s.component, a: s.a, b: s.b }); // its own range
      }
      if (pixel) await showProbe();
      document.body.dataset.shown = s.t;
      complain("");
    } catch (error) {
      complain(error.message);
    }
  }
  busy = false;
  document.body.dataset.ready = "yes";
}

function complain(text) {
  $("subject").textContent = text || `${state.config} · sequence ${state.sequence} · seed ${state.seed} · ${state.width} × ${state.height} · ${state.renderer}`;
  for (const id of ["low", "high", "seconds"]) $(id).classList.toggle("bad", Boolean(text));
}

// ---- probe ------------------------------------------------------------------------------------------------------

function element(tag, text = "", name = "") {
  const e = document.createElement(tag);
  e.textContent = text;
  if (name) e.className = name;
  return e;
}

function row(cells, kind = "td") {
  const tr = document.createElement("tr");
  for (const c of cells) tr.append(c instanceof Node ? c : element(kind, c));
  return tr;
}

const short = (v) => (v === null ? "" : typeof v === "number" ? String(Number(v.toPrecision(3))) : v);

async function showProbe() {
  const [x, y] = pixel;
  const found = await (await get("probe", { t: settings().t, x, y })).json();
  const buffers = element("table"), positions = element("table");
  buffers.append(row(["buffer", "GPU", "reference (float64)", "error", "ULPs", "unit"], "th"));
  for (const b of found.buffers) {
    const gpu = element("td", b.gpu_text), reference = element("td", b.reference_text);
    gpu.dataset.gpu = reference.dataset.reference = b.name;
    const tr = row([b.title, gpu, reference, element("td", short(b.error), "number"), element("td", short(b.ulps), "number"), b.error_unit]);
    if (b.ok === false) tr.className = "bad";
    tr.title = b.note;
    buffers.append(tr);
  }
  positions.append(row(["position", "GPU", "reference (float64)"], "th"));
  for (const p of found.positions) positions.append(row([p.name, p.gpu_text, p.reference_text]));
  const box = $("probe"), columns = element("div", "", "columns");
  columns.append(buffers, positions);
  box.replaceChildren(element("h2", `pixel (${x}, ${y})` + (found.band ? " — in the silhouette band: nothing is graded here" : "")), columns);
  for (const side of ["gpu", "reference"])
    box.append(element("p", (side === "gpu" ? "GPU drew " : "Reference hit ") + found.surface_text[side], "why"));
  for (const way of ["forward", "backward"])
    for (const side of ["gpu", "reference"])
      box.append(element("p", `${way}, ${side === "gpu" ? "GPU" : "reference"}: ${found.why[way][side] || "seen at both times"}`, "why"));
  for (const cross of document.querySelectorAll(".cross")) {
    cross.hidden = false;
    cross.style.left = (100 * (x + 0.5)) / state.width + "%";
    cross.style.top = (100 * (y + 0.5)) / state.height + "%";
  }
  box.dataset.pixel = `${x},${y}`;
}

// ---- where the fault is -----------------------------------------------------------------------------------------

let compared = null; // the moment and shaders that the verdict is about

async function compare() {
  const t = settings().t, box = $("verdict"), table = $("objects"), button = $("compare");
  button.disabled = true;
  box.textContent = "comparing …";
  box.className = "hint";
  table.hidden = true;
  try {
    const found = await (await get("verdict", { t })).json();
    compared = t;
    box.className = found.passed ? "good" : "bad";
    const unused = found.unused.map(([program, name]) => `${program}: the shader does not use '${name}' any more`);
    const said = found.first ? `the first that is wrong is ${found.first.title} (${found.first.source})` +
        found.first.suspicions.slice(0, 1).map((s) => `; it looks as if: ${s}`).join("")
      : `all ${found.compared} buffers agree with the reference`;
    box.textContent = `t = ${t} s: ${[...unused, said, found.not_graded].join("; ")}`;
    table.replaceChildren(row(["object", "first wrong", "px over", "of", "worst at", "then also", "looks as if"], "th"));
    for (const o of found.objects) {
      const place = element("a", `${o.x}, ${o.y}`);
      place.onclick = () => {
        pixel = [o.x, o.y];
        remember();
        showProbe().catch((e) => complain(e.message));
      };
      const cell = element("td");
      cell.append(place);
      table.append(row([o.object, found.titles[o.first], element("td", o.over_tolerance, "number"), element("td", o.pixels, "number"), cell,
                        o.then.map((name) => found.titles[name]).join(", "), o.suspicion]));
    }
    table.hidden = found.passed;
  } catch (error) {
    box.className = "bad";
    box.textContent = error.message;
  }
  button.disabled = false;
}

function forget() { // another moment, or other shaders
  if (compared === null) return;
  compared = null;
  $("verdict").className = "hint";
  $("verdict").textContent = "Something has changed since: compare again.";
  $("objects").hidden = true;
}

// ---- shaders that change ----------------------------------------------------------------------------------------

function showShaders(now) {
  const badge = $("reload"), box = $("errors");
  badge.textContent = now.errors.length ? "error: the last good shaders are shown" : `shaders, version ${now.generation}`;
  badge.classList.toggle("bad", now.errors.length > 0);
  box.hidden = !now.errors.length;
  box.replaceChildren(...now.errors.flatMap((e) => [element("b", `${e.where}: ${e.text}` + (e.stage ? ` [${e.stage} stage]` : "")), element("pre", e.excerpt)]));
}

async function follow(version, generation) {
  for (;;) {
    try {
      const now = await (await get("wait", { version })).json();
      if (now.version !== version) showShaders(now);
      if (now.generation !== generation) {
        forget();
        refresh();
      }
      ({ version, generation } = now);
    } catch (error) {
      $("reload").textContent = error instanceof TypeError ? "the server is gone" : error.message; // TypeError: nobody answered
      $("reload").classList.add("bad");
      await new Promise((done) => setTimeout(done, 1000));
    }
  }
}

// ---- start ------------------------------------------------------------------------------------------------------

function move(dx, dy) {
  if (!pixel) return;
  pixel = [Math.min(Math.max(pixel[0] + dx, 0), state.width - 1), Math.min(Math.max(pixel[1] + dy, 0), state.height - 1)];
  remember();
  showProbe().catch((e) => complain(e.message));
}

function label(direction) {
  const t = Number($("seconds").value), near = 1e-9;
  const next = direction > 0 ? state.labels.find((l) => l > t + near) : state.labels.findLast((l) => l < t - near);
  setTime(next ?? (direction > 0 ? state.t1 : state.t0));
  refresh();
}

async function start() {
  state = await (await get("state")).json();
  for (const id of ["a", "b"])
    for (const source of ["gpu", "reference"]) {
      const group = element("optgroup");
      group.label = source === "gpu" ? "GPU" : "float64 reference";
      for (const p of state.passes) group.append(new Option(p.title + (source === "gpu" ? "" : " (reference)"), `${p.name}:${source}`));
      $(id).append(group);
    }
  $("a").value = "flow_forward:gpu";
  $("b").value = "flow_forward:reference";
  for (const m of state.maps) $("map").append(new Option(m, m));
  Object.assign($("time"), { min: state.t0, max: state.t1, step: state.interval / 50 });
  recall();
  showShaders(state);
  let before = $("a").value.split(":")[0];
  $("a").addEventListener("change", () => { // B stays the counterpart of A when it was one
    const [now] = $("a").value.split(":"), [b, source] = $("b").value.split(":");
    if (b === before) $("b").value = `${now}:${source}`;
    before = now;
  });
  for (const id of SETTINGS) $(id).addEventListener("change", refresh);
  $("time").addEventListener("input", () => { setTime(Number($("time").value)); refresh(); });
  $("seconds").addEventListener("change", refresh);
  $("compare").onclick = compare;
  $("back").onclick = () => label(-1);
  $("next").onclick = () => label(1);
  for (const image of document.querySelectorAll(".picture img"))
    image.addEventListener("click", (event) => {
      const r = image.getBoundingClientRect();
      const at = (v, size, n) => Math.min(Math.max(Math.floor((v * n) / size), 0), n - 1);
      pixel = [at(event.clientX - r.left, r.width, state.width), at(event.clientY - r.top, r.height, state.height)];
      remember();
      showProbe().catch((e) => complain(e.message));
    });
  document.addEventListener("keydown", (event) => {
    if (["INPUT", "SELECT"].includes(event.target.tagName)) return;
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!arrows) return;
    if (event.shiftKey) move(...arrows);
    else if (arrows[0]) label(arrows[0]);
    else return;
    event.preventDefault();
  });
  const still = new URLSearchParams(location.hash.slice(1)).has("still"); // for screenshots, which wait until nothing is loading
  const fault = new URLSearchParams(location.hash.slice(1)).has("fault"); // and with the verdict
  refresh();
  if (fault) compare();
  if (!still) follow(state.version, state.generation);
}

start().catch((error) => { $("subject").textContent = error.message; });
