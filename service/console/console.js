// The operator's page: start scans, stop the arm, watch the skeleton grow.

import { follow } from "./events.js";
import { SkeletonView } from "./skeleton.js";

const $ = (id) => document.getElementById(id);
const FORMATS = ["json", "glb", "swc", "ply", "csv", "graphml"];
const FINISHED = ["done", "cancelled", "failed"];
const REFRESH_MS = 2000;
const view = new SkeletonView($("tree"));
let chosen = null;
let isReplay = false;
let stream = new AbortController();

async function ask(path, options) {
  let answer = await fetch(path, options);
  if (answer.status === 401) {
    const key = prompt("This rig wants its key:");
    if (key) sessionStorage.setItem("key", key.trim());
    if (key) answer = await fetch(path, withKey(options));
  }
  const body = await answer.json();
  if (!answer.ok) throw new Error(`${body.title}: ${body.detail}`);
  return body;
}

function withKey(options) {
  const key = sessionStorage.getItem("key");
  if (!key) return options;
  return { ...options, headers: { ...options.headers, Authorization: `Bearer ${key}` } };
}

function post(path, body, headers = {}) {
  if (body === undefined) return ask(path, withKey({ method: "POST" }));
  headers = { "Content-Type": "application/json", ...headers };
  return ask(path, withKey({ method: "POST", headers, body: JSON.stringify(body) }));
}

async function attempt(action) {
  try {
    await action();
    $("problem").textContent = "";
  } catch (error) {
    $("problem").textContent = error.message;
  }
}

function element(tag, text, properties = {}) {
  return Object.assign(document.createElement(tag), { textContent: text, ...properties });
}

async function showRig() {
  const { parts, paths } = await ask("/v1/rig");
  const missing = parts.filter((part) => !part.ready);
  $("ready").textContent = missing.length
    ? missing.map((part) => `${part.name}: ${part.detail || "not ready"}`).join(" · ")
    : "ready";
  $("ready").className = missing.length ? "bad" : "";
  const select = $("start").elements.path;
  if (!select.options.length) {
    select.replaceChildren(...Object.entries(paths).map(([name, count]) =>
      element("option", `${name} (${count} views)`, { value: name })));
  }
}

async function showScans() {
  const { scans } = await ask("/v1/scans");
  $("scans").replaceChildren(...scans.map((scan) => {
    const kind = scan.kind === "replay" ? "replay · " : "";
    const text = `${kind}${scan.tree_id} · ${scan.state} · ${scan.views_done}/${scan.views_total}`;
    const button = element("button", text, { type: "button", title: scan.scan_id });
    button.ariaCurrent = String(scan.scan_id === chosen);
    button.onclick = () => choose(scan);
    const item = document.createElement("li");
    item.append(button);
    return item;
  }));
  if (chosen === null && scans.length) choose(scans[0]);
}

function choose(scan) {
  chosen = scan.scan_id;
  isReplay = scan.kind === "replay";
  stream.abort();
  stream = new AbortController();
  $("scan").hidden = false;
  $("picture").hidden = true;
  $("events").replaceChildren();
  view.show(null);
  $("doubts").replaceChildren();
  const base = `/v1/scans/${chosen}`;
  $("recording").href = `${base}/recording.mcap`;
  $("formats").replaceChildren(...FORMATS.flatMap((format) =>
    [element("a", format, { href: `${base}/skeleton.${format}` }), " "]));
  showStatus(scan);
  watchSkeleton(base, stream.signal);
  follow(`${base}/events`, showEvent, stream.signal).then(showScans);
}

function showStatus(scan) {
  $("title").textContent = `${scan.tree_id} (${scan.scan_id})`;
  $("progress").max = scan.views_total || 1;
  $("progress").value = scan.views_done;
  $("detail").textContent =
    `${scan.state}, ${scan.views_done} of ${scan.views_total} views. ${scan.detail}`;
  $("detail").className = ["stopped", "failed"].includes(scan.state) ? "bad" : "";
  for (const button of document.querySelectorAll("[data-verb]")) {
    const moves = button.dataset.verb !== "cancel";
    button.disabled = FINISHED.includes(scan.state) || (isReplay && moves);
  }
  if (scan.views_done > 0) {
    const picture = `/v1/scans/${scan.scan_id}/views/${scan.views_done - 1}/color.jpg`;
    if ($("picture").getAttribute("src") !== picture) $("picture").src = picture;
  }
}

// Asks for the skeleton, and then for each newer one: the service answers when there is one.
async function watchSkeleton(base, signal) {
  let etag = "";
  while (!signal.aborted) {
    try {
      const headers = { "If-None-Match": etag, Prefer: "wait=20" };
      const answer = await fetch(`${base}/skeleton.json`, { headers, signal, cache: "no-store" });
      if (answer.ok) {
        etag = answer.headers.get("ETag");
        showSkeleton(await answer.json());
      } else if (answer.status !== 304) {
        $("legend").textContent = `Skeleton: ${(await answer.json()).detail}`;
      }
    } catch (error) {
      if (signal.aborted) return;
    }
    await new Promise((resolve) => setTimeout(resolve, REFRESH_MS / 4));
  }
}

function showSkeleton(skeleton) {
  const length = skeleton.branches.reduce((sum, branch) => sum + branch.length, 0);
  $("legend").textContent = `Skeleton of ${skeleton.views.used} views: ${length.toFixed(1)} m in`
    + ` ${skeleton.branches.length} branches; blue seen, orange predicted; drag to turn`;
  $("doubts").replaceChildren(...doubtsOf(skeleton.views).map((text) => element("li", text)));
  view.show(skeleton);
}

function doubtsOf({ moved = [], alone = [] }) {
  return [
    ...moved.map(({ index, by_m }) => `View ${index}: its pose was ${Math.round(100 * by_m)} cm off,`
      + " or the tree moved; it was taken to where the other views show its wood."),
    ...alone.map((index) => `View ${index} hardly agrees with any other: a wrong pose, another`
      + " tree, or it looks where no other does."),
  ];
}

function showEvent(kind, data) {
  const fields = Object.entries(data.fields).map(([name, value]) =>
    `${name} ${typeof value === "object" ? JSON.stringify(value) : value}`);
  const what = [kind, fields.join(", "), data.detail].filter(Boolean).join(" · ");
  $("events").prepend(element("li", `${data.at.slice(11, 23)} ${what}`));
  showStatus(data);
}

// crypto.randomUUID is missing where the page comes over plain HTTP from another machine.
function newKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

$("start").onsubmit = (event) => {
  event.preventDefault();
  const body = Object.fromEntries(new FormData(event.target));
  attempt(async () => {
    const scan = await post("/v1/scans", body, { "Idempotency-Key": newKey() });
    choose(scan);
    await showScans();
  });
};
$("replay").onchange = () => attempt(async () => {
  const [recording] = $("replay").files;
  if (!recording) return;
  $("replay").value = "";  // the same one may be chosen again
  const headers = { "Content-Type": "application/x-mcap" };
  const scan = await ask("/v1/replays", withKey({ method: "POST", headers, body: recording }));
  choose({ ...scan, kind: "replay" });
  await showScans();
});
$("picture").onerror = () => {
  $("picture").hidden = true;
  if (isReplay) return;  // its views may bear other numbers
  setTimeout(() => { $("picture").src += ""; }, REFRESH_MS);
};
$("picture").onload = () => { $("picture").hidden = false; };
$("stop").onclick = () => attempt(() => post("/v1/rig:stop"));
$("acknowledge").onclick = () => attempt(async () => {
  const reason = prompt("Why is it safe for the arm to move again?");
  if (reason) await post("/v1/rig:acknowledge", { reason });
});
for (const button of document.querySelectorAll("[data-verb]")) {
  button.onclick = () => attempt(() => post(`/v1/scans/${chosen}:${button.dataset.verb}`));
}

async function refresh() {
  try {
    await Promise.all([showRig(), showScans()]);
  } catch {
    $("ready").textContent = "no answer from the service";
    $("ready").className = "bad";
  }
  setTimeout(refresh, REFRESH_MS);
}
refresh();
