"use strict";
// Shows the snapshots of the running session. Every text goes in as text, never as markup.
const at = (id) => document.getElementById(id);
const text = (value, digits) =>
  value === null || value === undefined ? "–" : typeof value === "number" && digits !== undefined ? value.toFixed(digits) : String(value);
const share = (value) => (value === null || value === undefined ? "–" : (100 * value).toFixed(0) + " %");

function fill(body, rows) {
  body.replaceChildren(...rows.map((cells) => {
    const row = document.createElement("tr");
    cells.forEach((cell, place) => {
      const made = document.createElement(place === 0 ? "th" : "td");
      if (place === 0) made.scope = "row";
      if (typeof cell === "object" && cell !== null) { made.className = "number"; cell = cell.number; }
      made.textContent = text(cell);
      row.append(made);
    });
    return row;
  }));
}

const list = (place, lines) => place.replaceChildren(...lines.map((line) => {
  const item = document.createElement("li");
  item.textContent = line;
  return item;
}));

const number = (value, digits) => ({ number: text(value, digits) });

function show(snapshot) {
  at("result").hidden = snapshot === null || !snapshot.ending;
  if (snapshot === null) return;
  at("seen").hidden = at("share").hidden = false;
  const { bus, test, residuals, ending, signals } = snapshot;
  at("unit").textContent = "Unit " + text(snapshot.serial) + ", actuator type " + snapshot.actuator;
  at("verdict").textContent = ending ? ending.verdict.replace("_", " ") : "";
  at("verdict").className = "verdict " + (ending ? ending.verdict.replace(" ", "_") : "");
  list(at("reasons"), ending ? ending.reasons : []);
  at("trend").hidden = !ending || snapshot.serial === null;
  at("trend").href = "/history/" + snapshot.serial;
  const left = test && test.left_s !== null ? ", " + test.left_s.toFixed(1) + " s left" : "";
  at("phase").textContent = (test ? "Test " + test.name + ": " + test.phase + left : "No test") +
    (snapshot.working ? "; " + snapshot.working : "") + (snapshot.mode ? "; commands are a " + snapshot.mode : "");
  at("share").value = test && test.duration_s ? Math.min(test.elapsed_s / test.duration_s, 1) : 0;
  fill(at("bus"), [
    ["name", bus.name], ["state", bus.state + (bus.detail ? ": " + bus.detail : "")], ["frames", bus.frames],
    ["frames a second", text(bus.rate_per_s, 0)], ["load", share(bus.load)], ["lost ticks", bus.lost],
    ["dropped by this program", bus.dropped],
  ]);
  fill(at("severities"), snapshot.severities.map((item) =>
    [at("severities").dataset[item.name.toLowerCase()] ?? item.name, number(item.estimate, 4), number(item.std, 4), item.source]));
  fill(at("residuals"), residuals ? ["spool", "pressure"].map((name) =>
    [name, number(residuals[name], 2), number(residuals[name + "_above"], 2), number(residuals[name + "_below"], 2)]) : []);
  at("against").textContent = residuals && residuals.against ? "Compared with " + residuals.against : "";
  at("alarm-count").textContent = snapshot.alarm_count;
  fill(at("alarms"), snapshot.alarms.map((item) => [item.time.slice(11, 19) || item.time, item.causes.length ? item.causes.join("; or ") : item.signal, item.side, item.during]).reverse());
  list(at("notes"), snapshot.notes);
  draw(signals);
}

function draw(signals) {
  const source = Bokeh.documents.map((item) => item.get_model_by_name("signals")).find((item) => item);
  if (!source || signals.time_s.length === 0) return;
  const count = signals.time_s.length;
  const column = (values) => Float64Array.from({ length: count }, (_, i) => values[i] ?? NaN);
  const data = {};
  for (const name of Object.keys(source.data)) data[name] = column(signals[name] ?? []);
  source.data = data;
}

function request(path, body) {
  const token = new URLSearchParams(location.hash.slice(1)).get("token") ?? "";
  at("answer").textContent = "";
  fetch(path, { method: "POST", headers: { "X-Ehadiag-Token": token }, body: JSON.stringify(body) })
    .then((answer) => answer.json())
    .then((answer) => { at("answer").textContent = answer.error ?? ""; })
    .catch(() => { at("answer").textContent = "ehadiag serve does not answer"; });
}

const sliders = [...document.querySelectorAll("input[type=range]")];
for (const slider of sliders) {
  slider.addEventListener("input", () => { slider.nextElementSibling.textContent = slider.value + " %"; });
}
if (at("start")) {
  at("start").addEventListener("click", () => {
    at("confirm-test").textContent = at("test").value;
    at("confirm").showModal();
  });
  at("cancel").addEventListener("click", () => at("confirm").close());
  at("go").addEventListener("click", () => {
    at("confirm").close();
    const severities = Object.fromEntries(sliders.map((item) => [item.dataset.symbol, Number(item.value) / 100]));
    request("/start", sliders.length ? { test: at("test").value, severities } : { test: at("test").value });
  });
  at("abort").addEventListener("click", () => request("/abort", {}));
  addEventListener("keydown", (event) => {
    if (event.key === "Escape" && !at("confirm").open && !at("abort").disabled) request("/abort", {});
  });
}
const stream = new EventSource("/live");
stream.addEventListener("snapshot", (event) => show(JSON.parse(event.data)));
stream.addEventListener("state", (event) => {
  const state = JSON.parse(event.data);
  at("said").textContent = state.said.join("\n");
  const pages = state.said.flatMap((line) => line.match(/[^\/\\\s,]+\.html/g) ?? []);
  at("report").hidden = pages.length === 0;
  if (pages.length) at("report").href = "/reports/" + encodeURIComponent(pages.at(-1));
  if (state.running !== null && state.starting) {
    at("unit").textContent = "Starting test " + state.running + " …";
    at("phase").textContent = "Loading the model and opening the bus";
    at("result").hidden = at("seen").hidden = true; // of the test before
    at("share").hidden = false;
    at("share").removeAttribute("value");
  }
  if (at("start")) { at("start").disabled = state.running !== null; at("abort").disabled = state.running === null; }
});
stream.addEventListener("error", () => { at("phase").textContent = "ehadiag serve does not answer"; });
