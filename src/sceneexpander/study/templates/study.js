"use strict";
const $ = (id) => document.getElementById(id);
const facts = JSON.parse($("facts").textContent);
const count = facts.letters.length;
const KEPT = `study:${facts.keep}`;
const SECTIONS = ["loading", "consent", "task", "done", "withdrawn"];
const WATCHED = 0.9; // share of a video that counts as watched: browsers lose a frame or two at the ends

let state = null;     // what the server said last
let screen = null;    // the one that is shown
let places = [];      // by video: 1..count, or 0
let watched = [];     // by video
let busy = false;

// What the browser keeps is a convenience: private windows may refuse.
function keep(value) { try { localStorage.setItem(KEPT, JSON.stringify(value)); } catch { /* goes on without */ } }
function kept() { try { return JSON.parse(localStorage.getItem(KEPT)); } catch { return null; } }
function forget() { try { localStorage.removeItem(KEPT); } catch { /* as above */ } }

function notice(text) { $("notice").textContent = text; $("notice").hidden = !text; }

function pause(seconds) {
  return new Promise((resolve) => {
    const timer = setTimeout(done, seconds * 1000);
    function done() { clearTimeout(timer); removeEventListener("online", done); resolve(); }
    addEventListener("online", done);
  });
}

// Ask until the server answers. Every request may be repeated: the server counts an answer once.
async function ask(path, body) {
  for (let wait = 1; ; wait = Math.min(2 * wait, 15)) {
    try {
      const stop = new AbortController();
      const timer = setTimeout(() => stop.abort(), 15000);
      const options = { signal: stop.signal, cache: "no-store", credentials: "omit" };
      if (body !== undefined) {
        options.method = "POST";
        options.headers = { "Content-Type": "application/json" };
        options.body = JSON.stringify(body);
      }
      const reply = await fetch(path, options);
      const content = await reply.json();
      clearTimeout(timer);
      if (reply.status < 500) { notice(""); return { status: reply.status, content }; }
    } catch { /* no connection, or cut in the middle */ }
    notice("No connection to the study. Your places are kept on this device; trying again …");
    await pause(wait);
  }
}

function show(name) {
  for (const section of SECTIONS) $(section).hidden = section !== name;
  $("withdraw").hidden = !(name === "task" || name === "done");
  const heading = $(name).querySelector("h1");
  if (heading) { heading.focus({ preventScroll: true }); scrollTo(0, 0); }
}

function follow(next) {
  state = next;
  const number = state.done.length;
  $("progress").value = number;
  $("part").textContent = state.consented && state.next ? `${number + 1} of ${facts.screens.length}` : "";
  if (state.withdrawn) { screen = null; forget(); clear(); show("withdrawn"); }
  else if (!state.consented) show("consent");
  else if (state.next === null) { screen = null; forget(); clear(); $("code").textContent = state.code; show("done"); }
  else if (!screen || screen.name !== state.next) open(facts.screens.find((item) => item.name === state.next));
  else $("loading").hidden = true;
}

async function open(item) {
  screen = item;
  const saved = kept();
  const mine = saved && saved.screen === item.name;
  places = mine ? saved.places : Array(count).fill(0);
  watched = mine ? saved.watched : Array(count).fill(false);
  draw();
  show("task");
  if (mine && saved.sending) return send(); // it was on its way when the page went
  const reply = await ask("api/open", { screen: item.name });
  if (reply.status !== 200) refresh();
}

function clear() {
  for (const video of document.querySelectorAll("video")) { video.removeAttribute("src"); video.load(); }
  $("videos").replaceChildren();
}

function element(tag, properties, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function draw() {
  clear();
  const question = facts.questions[screen.question];
  const request = facts.requests[screen.request];
  $("question").textContent = question.title;
  $("explanation").textContent = question.text;
  $("prompt").textContent = request.prompt;
  $("picture").hidden = !request.picture;
  if (request.picture) $("picture").src = request.picture;
  $("missing").textContent = "";
  screen.videos.forEach((name, index) => $("videos").append(card(name, index)));
  mark();
}

function card(name, index) {
  const letter = facts.letters[index];
  const video = element("video", { src: `videos/${name}.mp4`, controls: true, muted: true, playsInline: true, preload: "metadata", disablePictureInPicture: true });
  video.setAttribute("aria-label", `Video ${letter}`);
  video.setAttribute("controlslist", "nodownload nofullscreen noremoteplayback");
  const seen = element("p", { className: "seen", id: `seen-${index}` });
  video.addEventListener("timeupdate", () => look(video, index));
  video.addEventListener("ended", () => look(video, index));
  video.addEventListener("error", () => {
    if (!video.getAttribute("src")) return; // the screen was left
    const again = element("button", { type: "button", textContent: "Load again" });
    again.onclick = () => { video.load(); mark(); };
    seen.replaceChildren("This video could not be loaded. ", again);
  });
  const buttons = facts.letters.split("").map((_, place) => {
    const end = place === 0 ? ", best" : place === count - 1 ? ", worst" : "";
    const button = element("button", { type: "button", textContent: String(place + 1) });
    button.setAttribute("aria-label", `Video ${letter}: place ${place + 1}${end}`);
    button.onclick = () => give(index, place + 1);
    return button;
  });
  const box = element("fieldset", {}, element("legend", { textContent: `Video ${letter}` }), video, seen,
    element("div", { className: "places" }, ...buttons),
    element("div", { className: "ends", ariaHidden: "true" }, element("span", { textContent: "best" }), element("span", { textContent: "worst" })));
  box.addEventListener("keydown", (event) => {
    const place = Number(event.key);
    if (!event.ctrlKey && !event.metaKey && !event.altKey && Number.isInteger(place) && place >= 1 && place <= count) {
      event.preventDefault();
      give(index, place);
    }
  });
  return box;
}

function look(video, index) {
  let seconds = 0;
  for (let part = 0; part < video.played.length; part++) seconds += video.played.end(part) - video.played.start(part);
  if (!watched[index] && video.duration > 0 && seconds >= WATCHED * video.duration) {
    watched[index] = true;
    keep({ screen: screen.name, places, watched, sending: false });
    mark();
  }
}

// Places stay a permutation: who had the place takes the one that becomes free, or none.
function give(index, place) {
  if (busy) return;
  const before = places[index];
  const holder = places.indexOf(place);
  if (holder === index) places[index] = 0;
  else {
    if (holder >= 0) places[holder] = before;
    places[index] = place;
  }
  keep({ screen: screen.name, places, watched, sending: false });
  mark();
}

function mark() {
  [...$("videos").children].forEach((box, index) => {
    box.classList.toggle("placed", places[index] > 0);
    [...box.querySelectorAll(".places button")].forEach((button, place) =>
      button.setAttribute("aria-pressed", String(places[index] === place + 1)));
    $(`seen-${index}`).textContent = watched[index] ? "✓ watched" : "not watched to its end yet";
  });
  const order = Array.from({ length: count }, (_, place) => { const at = places.indexOf(place + 1); return at < 0 ? "–" : facts.letters[at]; });
  $("summary").textContent = places.some((place) => place > 0) ? `Best to worst: ${order.join(" ")}` : "No places given yet";
  if ($("missing").textContent) $("missing").textContent = missing();
}

function missing() {
  const named = (test) => facts.letters.split("").filter((_, index) => test(index)).join(", ");
  const unseen = named((index) => !watched[index]);
  const unplaced = named((index) => !places[index]);
  return [unseen && `Watch to the end: ${unseen}.`, unplaced && `Give a place to: ${unplaced}.`].filter(Boolean).join(" ");
}

async function send() {
  if (busy) return;
  $("missing").textContent = missing();
  if ($("missing").textContent) return;
  busy = true;
  $("next").disabled = true;
  keep({ screen: screen.name, places, watched, sending: true });
  const ranks = Object.fromEntries(screen.videos.map((name, index) => [name, places[index]]));
  try {
    for (;;) {
      const reply = await ask("api/answer", { screen: screen.name, ranks });
      if (reply.status === 425) { // the screen has not been open for long enough
        for (let left = Math.ceil(reply.content.wait_s); left > 0; left--) {
          notice(`Please take a little more time; your answer is sent in ${left} s.`);
          await new Promise((resolve) => setTimeout(resolve, 1000));
        }
        continue;
      }
      forget();
      if (reply.status === 200) follow(reply.content);
      else { await refresh(); notice("This screen had been answered before, perhaps in another tab. The first answer counts."); }
      return;
    }
  } finally {
    busy = false;
    $("next").disabled = false;
  }
}

async function refresh() {
  const reply = await ask("api/state");
  if (reply.status === 200) follow(reply.content);
  else notice(reply.content.detail || "The study does not know this link.");
}

$("begin").onclick = async () => {
  if (!$("agree").checked) { notice("Please tick the box first, or close the page."); $("agree").focus(); return; }
  const reply = await ask("api/consent", {});
  if (reply.status === 200) follow(reply.content); else refresh();
};
$("next").onclick = send;
$("together").onclick = () => {
  for (const video of document.querySelectorAll("video")) { video.currentTime = 0; video.play().catch(() => {}); }
};
$("withdraw").onclick = () => { $("sure").hidden = false; $("no").focus(); };
$("no").onclick = () => { $("sure").hidden = true; $("withdraw").focus(); };
$("yes").onclick = async () => {
  const reply = await ask("api/withdraw", {});
  $("sure").hidden = true;
  if (reply.status === 200) follow(reply.content); else refresh();
};
// Another tab may have gone on meanwhile.
document.addEventListener("visibilitychange", () => { if (!document.hidden && !busy) refresh(); });
refresh();
