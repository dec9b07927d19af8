// The page: shows what the coordinator says, passes on what a person wants. What it shows
// is only ever text and numbers put into elements made here, never markup: names of shots
// and workers come from strangers.

import { draw } from "/chart.js";

const $ = (id) => document.getElementById(id);
const OVER = ["done", "failed", "canceled"];
const HISTORY_MAX = 720;

/// What part of each list is shown.
const lists = {
  shots: { state: "active", name: "", offset: 0, limit: 20, total: 0, rows: new Map() },
  workers: { state: "", name: "", offset: 0, limit: 50, total: 0, rows: new Map() },
};
let history = [];
let stream;

function make(name, properties = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(properties)) {
    if (key.includes("-")) element.setAttribute(key, value);
    else element[key] = value;
  }
  element.append(...children);
  return element;
}

/// Changes a property only if it is another one: nothing flickers, and the focus stays.
function set(element, key, value) {
  if (element[key] !== value) element[key] = value;
}

function duration(seconds) {
  if (seconds === null || !isFinite(seconds)) return "";
  const s = Math.round(seconds);
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${s % 60} s`;
  if (s < 172800) return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
  return `${Math.round(s / 86400)} days`;
}

const percent = (share) => `${Math.round(100 * share)} %`;
const rate = (perSecond) => (perSecond >= 10 ? perSecond.toFixed(0) : perSecond.toFixed(perSecond >= 1 ? 1 : 2));
const size = (bytes) => (bytes >= 999.5e6 ? `${(bytes / 1e9).toFixed(1)} GB` : `${(bytes / 1e6).toFixed(0)} MB`);
const count = (number) => number.toLocaleString("en").replaceAll(",", " ");

function say(text, bad = false) {
  $("said").textContent = text;
  $("said").classList.toggle("bad", bad);
}

/// Asks the API; returns its answer, or says why there is none.
async function ask(method, path, body) {
  try {
    const response = await fetch(`/api/v1/${path}`, { method, body: body && JSON.stringify(body) });
    const answer = await response.json();
    if (response.status === 401) location.assign("/login");
    if (!response.ok) throw new Error(answer.error);
    if (answer.done) say(answer.done);
    return answer;
  } catch (error) {
    say(error.message, true);
    return undefined;
  }
}

/// A button whose order is given at the second click within a few seconds.
function twice(button, text, question, order) {
  let timer;
  const calm = () => {
    clearTimeout(timer);
    timer = undefined;
    button.textContent = text;
    button.classList.remove("sure");
  };
  button.addEventListener("click", () => {
    if (timer) {
      calm();
      order();
      return;
    }
    button.textContent = question;
    button.classList.add("sure");
    timer = setTimeout(calm, 4000);
  });
}

function newShot(shot) {
  const part = {
    picture: make("img", { alt: "", loading: "lazy", hidden: true }),
    name: make("span", { className: "name" }),
    number: make("span", { className: "number" }),
    state: make("span", { className: "state" }),
    progress: make("progress"),
    facts: make("div", { className: "facts" }),
    note: make("div", { className: "note" }),
    pause: make("button"),
    less: make("button", { textContent: "−", title: "less urgent" }),
    more: make("button", { textContent: "+", title: "more urgent" }),
    cancel: make("button", { textContent: "cancel" }),
    links: make("div"),
  };
  const path = `shots/${shot.id}`;
  const frame = make("input", { type: "number", min: 0, required: true });
  const reason = make("output");
  const why = make("form", {}, make("label", {}, "frame ", frame), make("button", { textContent: "why is it not done?" }), reason);
  why.addEventListener("submit", async (event) => {
    event.preventDefault();
    const answer = await ask("GET", `${path}/frames/${Number(frame.value)}/why`);
    if (answer) reason.textContent = `frame ${answer.frame}: ${answer.why}`;
  });
  part.frame = frame;
  part.pause.addEventListener("click", () => ask("POST", `${path}/${part.shot.state === "paused" ? "resume" : "pause"}`));
  const urge = (step) => ask("PUT", `${path}/priority`, { priority: part.shot.priority + step });
  part.less.addEventListener("click", () => urge(-1));
  part.more.addEventListener("click", () => urge(1));
  twice(part.cancel, "cancel", "really?", () => ask("POST", `${path}/cancel`));
  // What has no picture shows none: the frame may be older than the coordinator.
  part.picture.addEventListener("error", () => set(part.picture, "hidden", true));
  part.picture.addEventListener("load", () => set(part.picture, "hidden", false));
  part.orders = make("div", { className: "orders" }, part.pause, part.less, part.more, part.cancel);
  part.element = make("li", { className: "shot" },
    make("div", { className: "picture" }, part.picture),
    make("div", { className: "head" }, make("div", { className: "title" }, part.name, part.number, part.state)),
    part.orders,
    make("div", { className: "body" }, part.progress, part.facts, part.note),
    make("details", { className: "more" }, make("summary", { textContent: "frames and files" }), why, part.links));
  return part;
}

function showShot(part, shot) {
  part.shot = shot;
  const over = OVER.includes(shot.state);
  set(part.name, "textContent", shot.name);
  set(part.name, "title", shot.name);
  set(part.number, "textContent", `#${shot.id}`);
  set(part.state, "textContent", shot.state);
  set(part.state, "className", `state ${shot.state}`);
  set(part.progress, "max", Math.max(1, shot.frames));
  set(part.progress, "value", shot.frames_done);
  part.progress.setAttribute("aria-label", `${shot.frames_done} of ${shot.frames} frames done`);
  const facts = [`${count(shot.frames_done)} of ${count(shot.frames)} frames`];
  if (shot.frames_failed) facts.push(`${count(shot.frames_failed)} failed`);
  if (shot.eta_s !== null && !over) facts.push(`${duration(shot.eta_s)} left`);
  if (shot.frames_per_s > 0 && !over) facts.push(`${rate(shot.frames_per_s)} frames/s`);
  facts.push(`${shot.size[0]} × ${shot.size[1]}`, shot.method, `priority ${shot.priority}`);
  if (!shot.queued) facts.push("ends with its client");
  set(part.facts, "textContent", facts.join(" · "));
  set(part.note, "textContent", shot.note);
  set(part.note, "hidden", shot.note === "");
  set(part.pause, "textContent", shot.state === "paused" ? "resume" : "pause");
  set(part.orders, "hidden", over);
  set(part.frame, "max", shot.first_frame + shot.frames - 1);
  set(part.frame, "min", shot.first_frame);
  part.less.setAttribute("aria-label", `less urgent: ${shot.name}`);
  part.more.setAttribute("aria-label", `more urgent: ${shot.name}`);
  part.pause.setAttribute("aria-label", `${part.pause.textContent} ${shot.name}`);
  part.cancel.setAttribute("aria-label", `cancel ${shot.name}`);
  const finished = (shot.queued && shot.state === "done" ? ["manifest.json"] : []).concat(shot.film ? ["film.mp4"] : []);
  if (part.finished !== finished.join()) {
    part.finished = finished.join();
    const link = (file) => make("a", { href: `/api/v1/shots/${shot.id}/${file}`, textContent: file });
    part.links.replaceChildren(...finished.map(link));
  }
  showPicture(part, shot);
}

/// The newest frame, at most every two seconds.
function showPicture(part, shot) {
  if (shot.last_frame === null || shot.last_frame === part.pictured) return;
  if (part.picturedAt && Date.now() - part.picturedAt < 2000) return;
  part.pictured = shot.last_frame;
  part.picturedAt = Date.now();
  part.picture.src = `/api/v1/shots/${shot.id}/last.jpg?frame=${shot.last_frame}`;
  part.picture.alt = `newest frame of ${shot.name}`;
}

function newWorker(worker) {
  const cell = (className) => make("span", { className, role: "cell" });
  const part = { name: cell("name"), state: cell("state"), speed: cell("speed"), work: cell("work"), jobs: cell("jobs"), shares: cell("shares"), cache: cell("cache"), drain: make("button", { textContent: "drain", title: "finish what it renders and leave" }) };
  twice(part.drain, "drain", "really?", () => ask("POST", `workers/${worker.id}/drain`));
  const action = make("span", { className: "action", role: "cell" }, part.drain);
  part.clear = make("button", { textContent: "clear", title: "trust it, and give it jobs of every shot", hidden: true });
  part.clear.addEventListener("click", () => ask("POST", `workers/${worker.id}/clear`));
  action.append(part.clear);
  part.element = make("div", { className: "worker", role: "row" }, part.name, part.state, part.speed, part.work, part.jobs, part.shares, part.cache, action);
  return part;
}

function showWorker(part, worker) {
  part.worker = worker;
  set(part.name, "textContent", worker.name);
  set(part.name, "title", `${worker.name}, worker-${worker.id}, ${worker.threads} threads`);
  const state = worker.distrusted ? "distrusted" : worker.state;
  set(part.state, "textContent", state);
  set(part.state, "className", `state ${state}`);
  set(part.speed, "textContent", `${worker.speed.toFixed(1)}×`);
  const work = [];
  if (worker.job) work.push(`#${worker.job.shot} frame ${worker.job.frame}` + (worker.jobs_held > 1 ? ` +${worker.jobs_held - 1}` : ""));
  if (worker.threads_allowed < worker.threads) work.push(`${worker.threads_allowed} of ${worker.threads} threads`);
  if (worker.blocked.length) work.push(`blocked for ${worker.blocked.map((shot) => `#${shot}`).join(", ")}`);
  if (worker.heard_ms > 3000) work.push(`silent for ${duration(worker.heard_ms / 1000)}`);
  set(part.work, "textContent", work.join(" · "));
  set(part.jobs, "textContent", count(worker.jobs_done) + (worker.jobs_failed ? `, ${count(worker.jobs_failed)} failed` : ""));
  set(part.shares, "textContent", `${percent(worker.rendering)} / ${percent(worker.terrain)}`);
  showCache(part.cache, worker.cache);
  set(part.drain, "disabled", worker.state === "draining");
  part.drain.setAttribute("aria-label", `drain ${worker.name}`);
  part.clear.setAttribute("aria-label", `clear ${worker.name}`);
  set(part.clear, "hidden", worker.blocked.length === 0 && !worker.distrusted);
}

/// What a worker holds of the terrain, in short; all of it where one points.
function showCache(cell, cache) {
  set(cell, "textContent", cache ? `${size(cache.memory_bytes)} / ${size(cache.disk_bytes)}` : "");
  cell.classList.toggle("bad", Boolean(cache?.damaged));
  set(cell, "title", cache ? [
    `memory: ${size(cache.memory_bytes)} of ${size(cache.memory_limit_bytes)}`,
    cache.disk_limit_bytes ? `disk: ${size(cache.disk_bytes)} of ${size(cache.disk_limit_bytes)}` : "nothing is kept on disk",
    `${size(cache.given_bytes)} given to other workers`,
    `${count(cache.damaged)} blobs were damaged`,
  ].join(", ") : "");
}

const kinds = {
  shots: { create: newShot, show: showShot, none: "no shot here; submit one with: terrafarm submit SCENE --flight FLIGHT" },
  workers: { create: newWorker, show: showWorker, none: "no worker here; start some with: terrafarm worker --coordinator HOST:PORT" },
};

/// Puts a page of a list in place; rows that stay are kept.
function showList(kind, page) {
  const list = lists[kind];
  const { create, show, none } = kinds[kind];
  const box = $(kind);
  const rows = new Map();
  page[kind].forEach((entry, index) => {
    const part = list.rows.get(entry.id) ?? create(entry);
    show(part, entry);
    rows.set(entry.id, part);
    if (box.children[index] !== part.element) box.insertBefore(part.element, box.children[index] ?? null);
  });
  while (box.children.length > rows.size) box.lastElementChild.remove();
  list.rows = rows;
  list.total = page.total;
  $(`${kind}-count`).textContent = count(page.total);
  const empty = $(`${kind}-empty`);
  empty.textContent = list.name ? `nothing here is called "${list.name}"` : none;
  empty.hidden = rows.size > 0;
  const pages = $(`${kind}-pages`);
  pages.hidden = page.total <= list.limit && page.offset === 0;
  const [before, where, after] = pages.children;
  before.disabled = page.offset === 0;
  after.disabled = page.offset + list.limit >= page.total;
  where.textContent = rows.size ? `${count(page.offset + 1)} to ${count(page.offset + rows.size)} of ${count(page.total)}` : `none of ${count(page.total)}`;
}

function showFarm(farm) {
  $("farm-name").textContent = farm.name;
  $("program").textContent = farm.program;
  $("total-workers").textContent = `${count(farm.workers.busy)} / ${count(farm.workers.connected)}`;
  $("total-threads").textContent = count(farm.workers.threads);
  $("total-rate").textContent = farm.now ? rate(farm.now.frames_per_s) : "–";
  $("total-frames").textContent = count(farm.frames_done);
  $("total-jobs").textContent = count(farm.jobs_running);
  $("total-repeated").textContent = count(farm.jobs_repeated);
  const newest = history.length ? history[history.length - 1].at_ms : -1;
  if (farm.now && farm.now.at_ms > newest) {
    history.push(farm.now);
    if (history.length > HISTORY_MAX) history.shift();
    draw($("chart"), history);
  }
}

/// Listens anew: to the parts of the lists that are shown now.
function listen() {
  stream?.close();
  const query = new URLSearchParams();
  for (const [kind, list] of Object.entries(lists)) {
    for (const key of ["state", "name", "offset", "limit"]) query.set(`${kind}_${key}`, list[key]);
  }
  stream = new EventSource(`/api/v1/events?${query}`);
  const link = $("link");
  const hear = (name, show) => stream.addEventListener(name, (event) => show(JSON.parse(event.data)));
  hear("farm", showFarm);
  hear("shots", (page) => showList("shots", page));
  hear("workers", (page) => showList("workers", page));
  stream.onopen = () => {
    link.className = "link live";
    link.textContent = "live";
    catchUp();
  };
  stream.onerror = async () => {
    link.className = "link lost";
    link.textContent = "connection lost, trying again";
    const answer = await fetch("/api/v1/farm").catch(() => undefined);
    if (answer?.status === 401) location.assign("/login");
    // The browser gives up where the server refuses; this page does not.
    if (stream.readyState === EventSource.CLOSED) setTimeout(listen, 3000);
  };
}

/// The history, which the stream does not repeat.
async function catchUp() {
  const farm = await ask("GET", "farm");
  if (!farm) return;
  history = farm.history;
  draw($("chart"), history);
}

for (const button of document.querySelectorAll("button[data-list]")) {
  const list = lists[button.dataset.list];
  button.addEventListener("click", () => {
    if (button.dataset.step) {
      list.offset = Math.max(0, list.offset + Number(button.dataset.step) * list.limit);
    } else {
      list.state = button.dataset.state;
      list.offset = 0;
      for (const other of button.parentElement.children) other.setAttribute("aria-pressed", String(other === button));
    }
    listen();
  });
}
for (const kind of ["shots", "workers"]) {
  let timer;
  $(`${kind}-name`).addEventListener("input", (event) => {
    clearTimeout(timer);
    timer = setTimeout(() => {
      lists[kind].name = event.target.value.trim();
      lists[kind].offset = 0;
      listen();
    }, 250);
  });
}
addEventListener("resize", () => draw($("chart"), history));
draw($("chart"), history);
listen();
