// The page: takes pictures, shows how far they are and where they lie, and asks for help where they were refused.
import * as view from "./map.mjs";
import { hintsOf, written } from "./points.mjs";

const $ = (id) => document.getElementById(id);
const WORDS = { located: "Located", ambiguous: "Two places", chosen: "Chosen by you", not_located: "Not located", failed: "Failed", running: "Working", dismissed: "Cancelled" };
const KEPT = "roadgeo.session";
const answers = [];  // latest first: { id, base, name, status, message, progress, document, view, hints }
let current = null, kept = 20, maxBytes = Infinity, hasMap = false, maps = [];

const make = (tag, properties = {}, ...children) => {
  const one = Object.assign(document.createElement(tag), properties);
  one.append(...children);
  return one;
};

// --- the server -------------------------------------------------------------------------------------------------------

class Problem extends Error {
  constructor(status, detail) {
    super(detail);
    this.status = status;
  }
}

async function ask(path, options) {
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Problem(0, "The server does not answer. Is roadgeo serve still running?");
  }
  const content = await answer.json().catch(() => ({}));
  if (!answer.ok) throw new Problem(answer.status, content.detail ?? `The server answered ${answer.status}.`);
  return content;
}

/** Ask until there is a free place. */
async function askUntilFree(path, options, entry) {
  for (;;) {
    try {
      return await ask(path, options);
    } catch (problem) {
      if (problem.status !== 503 || entry.status === "dismissed") throw problem;
      update(entry, { message: `waiting: ${problem.message}` });
      await new Promise((done) => setTimeout(done, 1000));
    }
  }
}

// --- answers ----------------------------------------------------------------------------------------------------------

async function takeFiles(files) {
  complain("");
  const entries = [...files].reverse().map((file) => add({ name: file.name, message: "sending", file, preview: URL.createObjectURL(file) }));
  if (entries.length) choose(entries.at(-1));
  for (const entry of entries.reverse()) {  // the first one is sent first, and stands on top
    if (entry.file.size > 0.99 * maxBytes) {
      update(entry, { status: "failed", message: `the file has ${megabytes(entry.file.size)}, this server takes ${megabytes(maxBytes)}: reduce it` });
      continue;
    }
    const body = new FormData();
    body.append("image", entry.file, entry.name);
    await start(entry, "locate", { method: "POST", body, headers: { Prefer: "respond-async" } });
  }
}

function add(entry) {
  const whole = { id: null, base: null, status: "running", progress: 0, hints: {}, since: Date.now(), ...entry };
  answers.unshift(whole);
  for (const old of answers.splice(kept)) {
    if (old.base) ask(old.base, { method: "DELETE" }).catch(() => {});
    if (old.preview) URL.revokeObjectURL(old.preview);
  }
  return whole;
}

async function start(entry, path, options) {
  try {
    const job = await askUntilFree(path, options, entry);
    Object.assign(entry, { id: job.jobID, base: `jobs/${job.jobID}`, file: null });
    if (entry.status === "dismissed") {
      await ask(entry.base, { method: "DELETE" });
      return;
    }
    watch(entry);
  } catch (problem) {
    update(entry, { status: "failed", message: problem.message });
  }
  keep();
}

function watch(entry) {
  const events = new EventSource(`${entry.base}/events`);
  events.onmessage = ({ data }) => {
    const job = JSON.parse(data);
    if (job.status === "accepted" || job.status === "running") {
      update(entry, { message: job.message, progress: job.progress });
      return;
    }
    events.close();
    finish(entry, job);
  };
  events.onerror = () => {
    if (events.readyState === EventSource.CLOSED) update(entry, { status: "failed", message: "the server has forgotten it" });
  };
}

async function finish(entry, job) {
  if (job.status !== "successful") {
    update(entry, { status: job.status === "dismissed" ? "dismissed" : "failed", message: job.message });
    return;
  }
  try {
    const { location } = await ask(`${entry.base}/results`);
    const seen = await ask(`${entry.base}/view.json`).catch(() => null);  // there was no room for it on the server's disk
    const message = [location.reason, location.error_rate?.said].filter(Boolean).join("; ");
    update(entry, { document: location, view: seen, status: location.status, message });
  } catch (problem) {
    update(entry, { status: "failed", message: problem.message });
  }
}

function update(entry, change) {
  const before = entry.status;
  Object.assign(entry, change);
  if (entry.status !== before && entry.status !== "running") {
    $("said").textContent = `${entry.name}: ${WORDS[entry.status]}. ${inFields(entry.message)}`;
    if (entry === current) show(entry);
  } else if (entry === current) {
    showProgress(entry);
  }
  showSession();
}

function keep() {
  const known = answers.filter(({ id }) => id).map(({ id, name, hints }) => ({ id, name, hints }));
  sessionStorage.setItem(KEPT, JSON.stringify(known));
}

/** What the page knew before it was loaded again. */
async function recall() {
  const known = JSON.parse(sessionStorage.getItem(KEPT) ?? "[]");
  for (const { id, name, hints } of known.slice(0, kept)) {
    const base = `jobs/${id}`;
    try {
      const job = await ask(base);
      const entry = { id, base, name, hints, status: "running", message: job.message, progress: job.progress, since: Date.now() };
      answers.push(entry);
      if (job.status === "accepted" || job.status === "running") watch(entry);
      else await finish(entry, job);
    } catch {
      continue;  // the server has been started anew, or keeps later ones
    }
  }
  if (answers.length) choose(answers[0]);
  keep();
}

// --- showing one ------------------------------------------------------------------------------------------------------

function choose(entry) {
  current = entry;
  resetHelp(entry);
  show(entry);
  showSession();
}

function show(entry) {
  const { document: found, view: seen, status } = entry;
  const over = status !== "running", placed = Boolean(seen?.place), sure = status === "located" || status === "chosen";
  document.body.classList.add("has-answers");
  $("answer").hidden = false;
  $("answer-name").textContent = entry.name;
  $("status").className = `status ${status}`;
  $("status").textContent = WORDS[status];
  $("progress").hidden = over;
  $("reason").textContent = over ? sentence(inFields(entry.message)) : "";
  showProgress(entry);
  showPicture(entry);
  $("facts").replaceChildren(...(sure ? facts(found, seen?.place?.matches ?? []) : []).flatMap(([name, value]) => [make("dt", { textContent: name }), make("dd", {}, value)]));
  $("layers").hidden = !placed;
  $("layers").querySelector(".slide").firstChild.textContent = seen?.is_photograph === false ? "Mask " : "Photograph ";
  $("help").hidden = !over || !entry.base || !seen;
  $("help").open = over && (status === "not_located" || status === "ambiguous");
  $("files-of").hidden = !over || !found;
  $("files-of").open = false;
  if (hasMap) {
    nameMap(found?.alternatives[0] && !sure ? found.alternatives[0].reference : found?.reference);
    view.showAnswer(entry.base, seen, found).then(() => entry === current && showPlaces(entry));
    view.showArea(sure || entry.hints.near === STATED ? null : entry.hints.near);
  }
  const refused = hasMap && status === "not_located" && found?.alternatives.length > 0;
  $("places").hidden = !refused && (status !== "ambiguous" || !placed);
  const wrong = found?.reason_code === "fits_elsewhere" ? "The first lies outside what you told. If that was wrong, take it:" : "None is sure enough. If you know one to be right, take it:";
  $("places").querySelector("p").textContent = refused ? wrong : "Which one is it?";
  if (sure) showFiles(entry);
}

/** Have the list of maps say which one is looked at. */
function nameMap(wanted) {
  const map = maps.findIndex(({ name }) => name === wanted);
  if (map >= 0) $("maps").selectedIndex = map;
}

function showProgress(entry) {
  const bar = $("progress").firstElementChild;
  if (entry.progress > 0) bar.value = entry.progress;
  else bar.removeAttribute("value");
  $("step").textContent = sentence(entry.message);
}

function showPicture(entry) {
  const { view: seen, preview } = entry;
  $("picture").classList.toggle("there", Boolean(seen || preview));
  $("seen").replaceChildren();
  $("larger").hidden = !seen;
  if (!seen) {
    if (preview) Object.assign($("photo"), { src: preview, alt: entry.name, onload: null, onerror: () => $("picture").classList.remove("there") });
    showPairs();
    return;
  }
  const [width, height] = seen.size, photo = $("photo"), drawn = $("seen");
  photo.src = `${seen.of ?? entry.base}/picture.jpg`;
  photo.alt = `${entry.name}, with ${seen.roads.length} roads that were seen in it`;
  drawn.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", seen.roads.map((line) => `M${line.map((point) => point.join(" ")).join("L")}`).join(""));
  drawn.replaceChildren(path);
  Object.assign(photo, { onload: layPins, onerror: null });
  layPins();
}

/** Lay what is drawn on the picture exactly over it. */
function layPins() {
  const { offsetWidth: width, offsetHeight: height } = $("photo");
  for (const one of [$("seen"), $("pins")]) Object.assign(one.style, { width: `${width}px`, height: `${height}px` });
  showPairs();
}

const megabytes = (bytes) => `${(bytes / 1e6).toFixed(0)} MB`;
const FIELDS = { near: "It is about here", gsd: "How large a pixel is", heading: "How it was held" };
/** Name the page's fields, not the command line's options. */
const inFields = (text) => text.replace(/--([a-z]+)(?: [A-Z][^\s)]*)?/g, (option, name) => (FIELDS[name] ? `“${FIELDS[name]}” below` : option));
const sentence = (text) => (text ? text[0].toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".") : "");
const degrees = ({ lat, lon }) => `${lat.toFixed(6)}, ${lon.toFixed(6)}`;
const length = (m) => (m < 1 ? `${(m * 100).toPrecision(2)} cm` : m < 10 ? `${m.toFixed(1)} m` : m < 1000 ? `${m.toFixed(0)} m` : `${(m / 1000).toFixed(1)} km`);
const WINDS = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"];

function facts(found, matches) {
  const copy = make("button", { type: "button", className: "link", textContent: degrees(found.center), title: "Copy" });
  copy.setAttribute("aria-label", `Middle ${degrees(found.center)}: copy`);
  copy.onclick = () => navigator.clipboard?.writeText(degrees(found.center)).then(() => { $("said").textContent = "Copied"; });
  const turn = ((found.rotation_deg % 360) + 360) % 360, rows = [["Middle", copy]];
  rows.push(["Pixel", `${found.gsd_m.toPrecision(3)} m`]);
  rows.push(["Up is", `${WINDS[Math.round(turn / 45) % 8]}, ${Math.round(turn) % 360}°`]);
  if (found.tilt_deg > 2) rows.push(["Tilt", `${found.tilt_deg.toFixed(0)}°`]);
  if (found.corner_sigma_m) rows.push(["Corners", `± ${length(Math.max(...found.corner_sigma_m))} (standard deviation, at worst)`]);
  if (found.camera) rows.push(["Camera", `${length(found.camera.height_m)} above the ground`]);
  if (found.n_matched) rows.push(["Roads", `${found.n_matched} of ${found.n_intersections} crossings matched`]);
  if (matches.length) {  // the largest come first
    rows.push(["Residuals", `median ${length(matches[matches.length >> 1].residual_m)}, largest ${length(matches[0].residual_m)}`]);
  }
  if (found.stated_offset_m !== null) rows.push(["By its own word", `the middle is ${length(found.stated_offset_m)} from here`]);
  if (found.reference) rows.push(["Map", found.reference]);
  if (found.part_read) rows.push(["Read", found.part_read]);
  return rows;
}

async function showFiles(entry) {
  try {
    const { files } = entry.files ?? await ask(`${entry.base}/files`);
    entry.files = { files };
    if (entry !== current) return;
    $("files-of").querySelector("ul").replaceChildren(...files.map(({ name, summary, href }) =>
      make("li", {}, make("a", { href, download: "" }, name, make("small", { textContent: summary })))));
  } catch (problem) {
    complain(problem.message);
  }
}

function showPlaces(entry) {
  const { status, document: found } = entry;
  const take = (i) => again(entry, { ...entry.hints, take: i + 1 });
  if (status === "not_located") offer(entry, found?.alternatives ?? [], "Take it", take);
  if (status === "ambiguous") offer(entry, [found, ...found.alternatives].slice(0, 6), "It is this one", take);
}

/** Show places by letters, on the map and in a list: one button goes there, another takes it. */
function offer(entry, places, words, take) {
  $("places").querySelector("ol").replaceChildren(...places.map((place, i) => {
    const letter = "ABCDEF"[i], { lon, lat } = place.center;
    const go = () => {
      view.lookAt(place);
      nameMap(place.reference);
    };
    view.addMarker([lon, lat], letter, `Place ${letter}: look at it`, "place").getElement().addEventListener("click", go);
    const where = [place.reference, entry.view?.streets?.[i], degrees(place.center), place.log10_odds === null ? "" : `score ${place.log10_odds.toFixed(1)}`];
    const there = make("button", { type: "button", onclick: go, title: "Look at it on the map" },
      make("b", { textContent: letter }), make("span", { textContent: where.filter(Boolean).join(", ") }));
    const taken = make("button", { type: "button", className: "take", onclick: () => take(i), textContent: words });
    taken.setAttribute("aria-label", `${words}: place ${letter}`);
    return make("li", {}, there, taken);
  }));
}

function showSession() {
  $("session").hidden = answers.length < 2;
  $("session").querySelector("ol").replaceChildren(...answers.map((entry) => {
    const picture = entry.view ? make("img", { src: `${entry.view.of ?? entry.base}/picture.jpg`, alt: "" }) : make("i");
    const row = make("button", { type: "button", onclick: () => choose(entry) }, picture, make("span", { textContent: entry.name }),
      make("small", { textContent: WORDS[entry.status], className: entry.status }));
    if (entry === current) row.setAttribute("aria-current", "true");
    return make("li", {}, row);
  }));
}

function complain(text) {
  $("trouble").textContent = text;
  $("trouble").hidden = !text;
}

// --- helping ----------------------------------------------------------------------------------------------------------

const MOST_POINTS = 5;
let pairs = [], waiting = null, picking = false;  // { pixel, lonlat }; a pixel that waits for its place

// Hints that a camera may state, and the fields in which they are typed instead.
const STATED = "exif", TYPED = { near: ["near-lat", "near-lon", "near-km"], gsd: ["gsd-low", "gsd-high", "height", "lens"], heading: ["heading", "heading-off"] };
const STATABLE = Object.keys(TYPED);

function resetHelp(entry) {
  const given = Object.entries(entry.hints).filter(([, value]) => value !== STATED);
  const { near, gsd, heading, maxTilt } = Object.fromEntries(given);
  STATABLE.forEach((name) => { $(`${name}-stated`).checked = entry.hints[name] === STATED; });
  const put = (id, value) => { $(id).value = value ?? ""; };
  setNear(near);
  put("heading", heading && round(heading[0]));
  put("heading-off", heading?.[1]);
  put("gsd-low", gsd && round(gsd[0]));
  put("gsd-high", gsd && round(gsd[1]));
  put("tilt", maxTilt);
  put("height");
  put("lens");
  pairs = entry.pairs ?? [];
  setPicking(false);
  stopDrawing();
}

const round = (value) => Number(value.toPrecision(6));
function setNear(near) {
  const [lon, lat, m] = near ?? [];
  [["near-lon", lon?.toFixed(6)], ["near-lat", lat?.toFixed(6)], ["near-km", m && (m / 1000).toPrecision(3)]].forEach(([id, text]) => { $(id).value = text ? Number(text) : ""; });
}

/** What is known, from the form. */
function readHints(size) {
  const number = (id) => ($(id).value === "" ? undefined : Number($(id).value));
  const hints = {}, [lat, lon, km] = ["near-lat", "near-lon", "near-km"].map(number);
  const given = [lat, lon, km].filter((value) => value !== undefined).length;
  if (given && given < 3) throw new Error("Give the latitude, the longitude and how far around.");
  if (given) hints.near = [lon, lat, km * 1000];
  const [low, high, height, lens] = ["gsd-low", "gsd-high", "height", "lens"].map(number);
  if (low !== undefined || high !== undefined) hints.gsd = [low ?? high / 1.25, high ?? low * 1.25];
  else if (height !== undefined && lens !== undefined) {
    const focal = lens / 36 * Math.max(...size);  // film of 35 mm is 36 mm wide
    hints.focal = round(focal);
    hints.gsd = [round(height / focal / 1.25), round(height / focal * 1.25)];
  } else if (height !== undefined || lens !== undefined) throw new Error("Give both the height and the lens.");
  if (hints.gsd && !(hints.gsd[0] > 0 && hints.gsd[0] <= hints.gsd[1])) throw new Error("Pixel size: the first must not exceed the second.");
  if (number("heading") !== undefined) hints.heading = [number("heading"), number("heading-off") ?? 10];
  if (number("tilt") !== undefined) hints.maxTilt = number("tilt");
  STATABLE.filter((name) => $(`${name}-stated`).checked).forEach((name) => { hints[name] = STATED; });
  return hints;
}

function again(entry, hints) {
  const query = Object.entries(hints).map(([name, value]) => `${name}=${value}`).join("&");
  const next = add({ name: entry.name, hints, message: "searching again", pairs, view: entry.view && { ...entry.view, place: null, of: entry.base } });
  choose(next);
  scrollUp();
  return start(next, `${entry.view.of ?? entry.base}/again?${query}`, { method: "POST" });  // of a failed one nothing is kept
}

/** Have the picture placed by the points, as they are. */
function putThere() {
  $("hint-trouble").textContent = "";
  return again(current, { points: written(pairs) });
}

function scrollUp() {
  $("panel").scrollTo({ top: 0 });
  if (innerWidth <= 760) scrollTo({ top: 0 });
}

function searchAgain() {
  $("hint-trouble").textContent = "";
  const entry = current;
  try {
    const hints = readHints(entry.view.size);
    return again(entry, { ...hints, ...hintsOf(pairs, entry.view.size) });
  } catch (error) {
    $("hint-trouble").textContent = error.message;
    return null;
  }
}

function startDrawing() {
  const button = $("draw-circle"), on = button.getAttribute("aria-pressed") === "true";
  stopDrawing();
  if (on || !hasMap) return;
  setPicking(false);
  button.setAttribute("aria-pressed", "true");
  tell("Press in the middle, and draw the circle outwards");
  if (innerWidth <= 760) scrollTo({ top: 0 });
  view.drawCircle((near) => {
    stopDrawing();
    setNear(near);
    searchAgain();
  });
}

function stopDrawing() {
  $("draw-circle").setAttribute("aria-pressed", "false");
  if (hasMap) view.stopDrawing();
  tell("");
}

function tell(text) {
  $("asks").textContent = text;
  $("asks").hidden = !text;
}

// --- points -----------------------------------------------------------------------------------------------------------

function setPicking(on) {
  picking = on && hasMap;
  waiting = null;
  $("pick").setAttribute("aria-pressed", String(picking));
  $("picture").classList.toggle("picks", picking);
  $("photo").tabIndex = picking ? 0 : -1;
  $("aim").hidden = $("take-middle").hidden = true;
  if (hasMap) view.onClick(null);
  tell(picking ? "Click a crossing in the picture" : "");
  if (picking) $("picture").scrollIntoView({ block: "nearest" });
  showPairs();
}

function pixelAt({ clientX, clientY }) {
  const edge = $("photo").getBoundingClientRect(), [width, height] = current.view.size;
  return [(clientX - edge.left) / edge.width * width, (clientY - edge.top) / edge.height * height];
}

function pickPixel(pixel) {
  if (pairs.length >= MOST_POINTS) return;
  waiting = pixel;
  showPairs();
  tell(`Now click the same crossing on the map (${pairs.length + 1})`);
  $("take-middle").hidden = false;
  if (innerWidth <= 760) scrollTo({ top: 0 });
  view.onClick(setPlace);
}

function setPlace(lonlat) {
  view.onClick(null);
  $("take-middle").hidden = true;
  pairs.push({ pixel: waiting, lonlat });
  waiting = null;
  showPairs();
  tell(["One more: click another crossing in the picture", "A third crossing in the picture, or “Search again” near these two"][pairs.length - 1]
    ?? "“Put it there” places the picture by these points, as they are");
}

function showPairs() {
  if (!current?.view) return;
  const [width, height] = current.view.size;
  const all = [...pairs.map((one) => one.pixel), ...(waiting ? [waiting] : [])];
  $("points").replaceChildren(...all.map(([column, row], i) => {
    const pin = make("button", { type: "button", className: "pin", textContent: i + 1 });
    pin.setAttribute("aria-label", `Point ${i + 1} in the picture`);
    Object.assign(pin.style, { left: `${100 * column / width}%`, top: `${100 * row / height}%` });
    return pin;
  }));
  $("pairs").replaceChildren(...pairs.map(({ lonlat: [lon, lat] }) => make("li", { textContent: degrees({ lat, lon }) })));
  $("unpick").hidden = !all.length;
  $("put").hidden = pairs.length < 3;
  if (!hasMap || current.status === "ambiguous") return;
  view.clearMarkers();
  if (!all.length) showPlaces(current);
  pairs.forEach(({ lonlat }, i) => {
    const marker = view.addMarker(lonlat, i + 1, `Point ${i + 1} on the map`, "mapped", { draggable: true });
    marker.on("dragend", () => {
      const { lng, lat } = marker.getLngLat();
      pairs[i] = { ...pairs[i], lonlat: [lng, lat] };
      if (current.hints.points) putThere();
      else if (pairs.length === 2) searchAgain();
    });
  });
}

let aim = [0.5, 0.5];
/** Choose a point by keys: arrows move a cross over the picture, Enter takes it; then the map is moved likewise. */
function aimByKeys(event) {
  const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  if (!picking || !(step || event.key === "Enter")) return;
  event.preventDefault();
  if (step) aim = aim.map((share, k) => Math.min(Math.max(share + step[k] * (event.shiftKey ? 0.05 : 0.005), 0), 1));
  Object.assign($("aim").style, { left: `${100 * aim[0]}%`, top: `${100 * aim[1]}%` });
  $("aim").hidden = false;
  if (step) return;
  $("aim").hidden = true;
  pickPixel(current.view.size.map((side, k) => side * aim[k]));
  view.theMap().getCanvas().focus();
}

// --- begin ------------------------------------------------------------------------------------------------------------

function listen() {
  const hasFiles = (event) => event.dataTransfer?.types.includes("Files");
  $("files").addEventListener("change", () => {
    takeFiles($("files").files);
    $("files").value = "";
  });
  addEventListener("dragover", (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    $("drag").hidden = false;
  });
  addEventListener("dragleave", (event) => { if (!event.relatedTarget) $("drag").hidden = true; });
  addEventListener("drop", (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    $("drag").hidden = true;
    takeFiles(event.dataTransfer.files);
  });
  addEventListener("paste", (event) => event.clipboardData?.files.length && takeFiles(event.clipboardData.files));
  $("cancel").onclick = () => {
    const entry = current;
    update(entry, { status: "dismissed", message: "it was cancelled" });
    if (entry.base) ask(entry.base, { method: "DELETE" }).catch(() => {});
  };
  $("opacity").oninput = () => view.setOpacity($("opacity").value / 100);
  $("show-roads").onchange = () => view.showLayers(["seen", "seen-case"], $("show-roads").checked);
  $("show-matches").onchange = () => view.showLayers(["matches", "ends"], $("show-matches").checked);
  $("files-of").ontoggle = () => $("files-of").open && current?.document && showFiles(current);
  $("draw-circle").onclick = startDrawing;
  $("maps").onchange = () => view.fit(maps[$("maps").selectedIndex].bounds);
  $("near-middle").onclick = () => {
    if (hasMap) setNear([...view.middle(), 1000 * (Number($("near-km").value) || 3)]);
    showTyped();
  };
  for (const id of ["near-lat", "near-lon", "near-km"]) $(id).onchange = showTyped;
  $("hints").onsubmit = (event) => {
    event.preventDefault();
    searchAgain();
  };
  $("pick").onclick = () => setPicking(!picking);
  $("unpick").onclick = () => {
    pairs = [];
    setPicking(picking);
  };
  $("put").onclick = putThere;
  Object.entries(TYPED).forEach(([name, fields]) => {
    const tick = $(`${name}-stated`);
    tick.addEventListener("change", () => tick.checked && fields.forEach((id) => { $(id).value = ""; }));
    fields.forEach((id) => $(id).addEventListener("input", () => { tick.checked = false; }));
  });
  $("photo").onclick = (event) => picking && pickPixel(pixelAt(event));
  $("photo").onkeydown = aimByKeys;
  $("take-middle").onclick = () => waiting && setPlace(view.middle());
  $("larger").onclick = () => {
    const on = $("panel").classList.toggle("large");
    $("larger").setAttribute("aria-pressed", String(on));
    $("larger").textContent = on ? "Smaller" : "Larger";
    layPins();
  };
  addEventListener("resize", layPins);
  addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    stopDrawing();
    setPicking(false);
  });
}

function showTyped() {
  const [lat, lon, km] = ["near-lat", "near-lon", "near-km"].map((id) => ($(id).value === "" ? NaN : Number($(id).value)));
  view.showArea([lat, lon, km].every(Number.isFinite) && km > 0 ? [lon, lat, km * 1000] : null);
}

function askToken() {
  $("token").hidden = false;
  $("token-text").focus();
  $("token").onsubmit = async (event) => {
    event.preventDefault();
    try {
      await ask("session", { method: "POST", body: $("token-text").value });
      location.reload();
    } catch (problem) {
      $("token").querySelector(".bad").textContent = sentence(problem.message);
    }
  };
}

async function begin() {
  let server;
  try {
    server = await ask("references");
  } catch (problem) {
    if (problem.status === 401) askToken();
    else complain(problem.message);
    $("work").hidden = problem.status === 401;
    return;
  }
  kept = server.kept;
  maxBytes = server.max_bytes;
  maps = server.references;
  $("work").hidden = false;
  hasMap = view.makeMap(server);
  $("maps").replaceChildren(...maps.map(({ name }) => new Option(name)));
  $("maps").hidden = !hasMap || maps.length < 2;
  if (!hasMap) complain("This browser cannot draw the map (it has no WebGL). Places are told all the same.");
  $("credit").textContent = `Searching ${maps.map(({ name }) => name).join(", ")}. Nothing leaves this server${server.basemap ? " but what the basemap shows" : ""}.`;
  listen();
  await recall();
}

begin();
