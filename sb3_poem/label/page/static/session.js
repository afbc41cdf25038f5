// The conversation. The server keeps all of it; this page shows where it stands and says what was clicked.
"use strict";

const POLL_MILLISECONDS = 150;
const RETRY_MILLISECONDS = 1000;
const SLOW_AFTER_MILLISECONDS = 4000;
const GIVE_UP_MILLISECONDS = 20000; // and ask again: a lost connection may never say so
const SILENT = ["TimeoutError", "AbortError"]; // of `fetch` then, by the browser
const base = window.location.pathname.replace(/\/+$/, "");
const byId = (id) => document.getElementById(id);
const four = document.querySelector('[data-preference="first"]') !== null;
const [films, closer, what] = four ? ["four", "closest", "Question"] : ["two", "closer", "Pair"];
const screens = [...document.querySelectorAll("#screens canvas")];
const firstLabel = screens[0].getAttribute("aria-label");
const player = new Player(
  screens,
  { play: byId("play"), frame: byId("frame"), speed: byId("speed"), moment: byId("moment"), icon: byId("play-icon") },
  showError,
);
const storage = browserStorage();
let view = null;
let shownTurn = null;
let busy = false;
let waitingSince = null;

// A browser may refuse to keep anything for a page in another's frame, as in a notebook.
function browserStorage() {
  try {
    return window.localStorage;
  } catch {
    return { getItem: () => null, setItem() {}, removeItem() {} };
  }
}

async function ask(path, body) {
  const options = { signal: AbortSignal.timeout?.(GIVE_UP_MILLISECONDS) };
  if (body !== undefined) {
    Object.assign(options, {
      method: "POST",
      keepalive: true, // a page that is closed still sends it
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(body),
    });
  }
  const response = await fetch(base + path, options);
  const data = await response.json().catch((error) => {
    if (SILENT.includes(error.name)) throw error;
    return null;
  });
  if (response.ok && data) return data;
  const other = "Something else than the server answers: perhaps you must log in again, in another tab.";
  const error = new Error(data?.error || (response.ok ? other : `The server answers ${response.status}.`));
  if (!response.ok) error.status = response.status; // else it is not ours: another's login page, say
  throw error;
}

// What the server has not confirmed, by path: it outlives the page, and is sent until it is kept.
// The server takes the same thing twice as once.
const unsent = readKept();
const deliveries = {};

// An item a path: another tab of this conversation may keep or forget something at the same moment.
function readKept() {
  const kept = Object.keys(storage).filter((key) => key.startsWith(`${base}/`));
  return Object.fromEntries(kept.map((key) => [key.slice(base.length), JSON.parse(storage.getItem(key))]));
}

function send(path, body) {
  unsent[path] = body;
  storage.setItem(base + path, JSON.stringify(body));
  deliveries[path] ??= deliver(path).finally(() => delete deliveries[path]);
  return deliveries[path];
}

async function deliver(path) {
  for (;;) {
    const body = unsent[path];
    let next = null;
    try {
      next = await ask(path, body);
    } catch (error) {
      if (isPassing(error)) {
        showError(inSentence(error));
        await pause(RETRY_MILLISECONDS, "online");
        continue;
      }
      if (error.status !== 401) forget(path); // that waits for who comes by the right link
      throw error;
    }
    showError("");
    if (unsent[path] === body) return forget(path) || next;
  }
}

function forget(path) {
  delete unsent[path];
  storage.removeItem(base + path);
}

// No answer, no room, no disk, or too slow on its way: it may come.
const isPassing = (error) => error.status === undefined || error.status >= 500 || error.status === 408;

function showError(message) {
  byId("error").textContent = message || "";
  byId("error").hidden = !message;
}

function say(text) {
  byId("status").textContent = text;
}

const pause = (milliseconds, event) => new Promise((resolve) => {
  setTimeout(resolve, milliseconds);
  if (event) window.addEventListener(event, resolve, { once: true });
});

// Sends what the person did, then follows the conversation until something is shown again.
async function act(path, body) {
  if (busy) return;
  busy = true;
  showError("");
  byId("board").classList.add("busy");
  try {
    await show(await send(path, body));
  } catch (error) {
    // Out of step, perhaps because of another tab: see where the conversation is.
    if (error.status !== 409) showError(inSentence(error));
  }
  await follow();
  byId("board").classList.remove("busy");
  busy = false;
}

// `fetch` has a TypeError for a server that it does not reach.
function inSentence(error) {
  if (!["TypeError", ...SILENT].includes(error.name)) return error.message;
  return "The server does not answer. What you answered is kept in this browser, and sent as soon as it does…";
}

async function follow() {
  for (;;) {
    try {
      const next = await ask("/state");
      showError(next.failed || "");
      await show(next);
      if (next.phase !== "preparing") return;
      await pause(POLL_MILLISECONDS);
    } catch (error) {
      showError(inSentence(error));
      if (!isPassing(error)) return;
      await pause(RETRY_MILLISECONDS, "online");
    }
  }
}

async function show(next) {
  const changed = view === null || JSON.stringify(next.belief) !== JSON.stringify(view.belief);
  if (JSON.stringify(next.answers) !== JSON.stringify(view?.answers)) showPast(next.answers);
  view = next;
  const { phase, answered, target, step } = next;
  const waiting = phase === "preparing";
  const result = next.due === "result";
  const accepted = result && next.turn && next.turn.verdict === "yes";
  byId("board").dataset.phase = phase;
  showProgress(waiting, answered, result);
  showCount(answered, target, result);
  if (changed && next.belief) {
    drawBelief(byId("belief"), next.belief);
    byId("belief-sentence").textContent = next.belief.sentence;
  }
  byId("undo").hidden = !next.can_undo;
  const back = isStopped();
  byId("undo-text").textContent = back ? "Back to the questions" : "Undo";
  byId("undo-what").hidden = back;
  byId("stop").hidden = phase !== "question" || answered === 0;
  for (const button of document.querySelectorAll(".answer")) button.setAttribute("aria-disabled", String(waiting));
  showDoubt();
  if (waiting) return;
  byId("board").classList.remove("past");
  if (next.turn.id !== shownTurn) {
    await player.load(`${base}/video/${next.turn.id}`, next.turn.fps, next.turn.frames);
    shownTurn = next.turn.id;
    if (phase === "question") say(`Question ${answered + 1} of ${target}. ${byId("doubt").hidden ? "" : byId("doubt").textContent}`);
    else say("This is what it learned. Is this what you meant?");
  }
  byId("board").classList.toggle("single", phase === "result");
  showRace();
  byId("answers").hidden = phase !== "question";
  byId("result").hidden = phase !== "result";
  byId("hint").hidden = phase !== "question";
  byId("task").textContent = phase === "question" ? question()
    : accepted ? "This is what it learned." : "This is what it learned. Is this what you meant?";
  screens[0].setAttribute("aria-label", phase === "question" ? firstLabel : "What it learned");
  byId("thanks").hidden = !accepted;
  byId("more").textContent = `Not quite – ask me ${step} more`;
  document.querySelector('[data-verdict="yes"]').hidden = accepted;
  if (phase === "result") {
    byId("get-video").href = `${base}/video/${next.turn.id}`;
    byId("get-answers").href = `${base}/answers.json`;
    byId("get-policy").href = `${base}/policy.safetensors`;
  }
}

// The answers so far, in the buttons' words. Their films can be seen again; nothing is answered there.
function showPast(answers) {
  byId("past").hidden = answers.length === 0;
  byId("past-list").replaceChildren(...answers.map((given, index) => {
    const item = document.createElement("li");
    const again = document.createElement("button");
    again.type = "button";
    again.className = "link";
    again.textContent = "Show again";
    again.setAttribute("aria-label", `Show again: ${what.toLowerCase()} ${index + 1}`);
    again.addEventListener("click", () => lookBack(given, index));
    item.append(...inWords(given.preference), " ", again);
    return item;
  }));
}

function inWords(preference) {
  const words = document.querySelector(`[data-preference="${preference}"]`).cloneNode(true);
  words.querySelector("kbd")?.remove();
  return words.childNodes;
}

async function lookBack(given, index) {
  if (busy || view.phase === "preparing") return;
  busy = true;
  try {
    await player.load(`${base}/video/${given.question}`, given.fps, given.frames);
  } catch (error) {
    return showError(inSentence(error));
  } finally {
    busy = false;
  }
  shownTurn = given.question; // what waits takes no answer meanwhile
  byId("board").classList.add("past");
  byId("board").classList.remove("single");
  screens[0].setAttribute("aria-label", firstLabel);
  showRace();
  byId("task").textContent = `${what} ${index + 1}, as you saw it.`;
  byId("then-text").replaceChildren("You said: ", ...inWords(given.preference), ".");
  say(`${what} ${index + 1} again. ${byId("then-text").innerText}`);
  byId("back").focus();
  byId("stage").scrollIntoView(); // the films, above the list
}
byId("back").addEventListener("click", async () => {
  if (busy) return;
  await start();
  byId("past").firstChild.focus();
});

function question() {
  const { repeats } = view.turn;
  return `${repeats === null ? "Which" : `${what} ${repeats + 1} once more: which`} one is ${closer} to what you want?`;
}

// Offers to look again at the answer that the others contradict, once.
function showDoubt() {
  const number = view.phase === "question" && view.turn.repeats === null ? view.belief.contradicted ?? null : null;
  byId("doubtful").textContent = number === null ? "" : number + 1;
  byId("doubt").hidden = number === null;
}
byId("again").addEventListener("click", () => act("/again", { question: view.turn.id }));

// Both robots in one picture, instead of the two, where the video has one and it is wanted for this robot.
const raceKey = `race ${byId("board").dataset.robot}`;
let wantsRace = !four && (storage.getItem(raceKey) ?? byId("board").dataset.race) === "on";

function showRace() {
  const has = player.parts === 3;
  byId("race").hidden = !has;
  byId("race").setAttribute("aria-pressed", String(wantsRace));
  byId("board").classList.toggle("racing", wantsRace && player.parts !== 2); // a result is one: the names stay
}

function race() {
  if (player.parts !== 3) return;
  wantsRace = !wantsRace;
  storage.setItem(raceKey, wantsRace ? "on" : "off");
  showRace();
  say(wantsRace ? "Both in one picture, blue and orange." : "Two pictures, left and right.");
}
byId("race").addEventListener("click", race);
if (!wantsRace) player.parts = 2; // until a film says otherwise: who wants a race has seen that there is one
showRace(); // the first films find their place kept, and move nothing

// Films and answers alone, as large as the screen.
function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else if (document.fullscreenEnabled) byId("stage").requestFullscreen().catch((error) => showError(error.message));
}
byId("full").hidden = !document.fullscreenEnabled;
byId("full").addEventListener("click", fullScreen);
document.addEventListener("fullscreenchange", () => {
  const full = document.fullscreenElement !== null;
  byId("full").setAttribute("aria-pressed", String(full));
  say(full ? "Full screen; Escape leaves it." : "No longer full screen.");
});

function showProgress(waiting, answered, result) {
  if (!waiting) waitingSince = null;
  else if (waitingSince === null) waitingSince = performance.now();
  byId("progress").hidden = !waiting;
  const slow = waiting && performance.now() - waitingSince > SLOW_AFTER_MILLISECONDS;
  const what = result ? "Filming what it learned" : `Preparing the ${answered === 0 ? "first" : "next"} ${films} videos`;
  const calm = `${answered === 0 ? "This" : "Your answers are safe; this"} takes a few seconds…`;
  byId("progress-text").textContent = slow ? `${what}. ${calm}` : `${what}…`;
}

function showCount(answered, target, result) {
  byId("count").textContent = result ? `${answered} answer${answered === 1 ? "" : "s"}` : `${answered + 1} of ${target}`;
  const dots = byId("dots");
  dots.replaceChildren();
  for (let i = Math.max(0, target - 10); i < target; i++) {
    const dot = document.createElement("i");
    dot.className = i < answered ? "full" : i === answered && !result ? "now" : "";
    dots.appendChild(dot);
  }
}

function answer(preference) {
  if (busy || view === null || view.phase !== "question" || view.turn.id !== shownTurn) return;
  const button = document.querySelector(`[data-preference="${preference}"]`);
  if (button === null) return; // this kind of question has no such answer
  button.classList.add("chosen");
  setTimeout(() => button.classList.remove("chosen"), 400);
  act("/answer", { question: view.turn.id, preference });
}

const isStopped = () => view.due === "result" && view.answered < view.target;
// Each says what it comes to, so that sent twice it does no more.
const goBack = () => (isStopped() ? act("/stop", { stopped: 0 }) : act("/undo", { answered: view.answered }));
const undo = () => view && view.can_undo && goBack();

for (const button of document.querySelectorAll("[data-preference]")) {
  button.addEventListener("click", () => answer(button.dataset.preference));
}
for (const button of document.querySelectorAll("[data-verdict]")) {
  button.addEventListener("click", () => view.turn && act("/verdict", { result: view.turn.id, verdict: button.dataset.verdict }));
}
byId("undo").addEventListener("click", undo);
byId("stop").addEventListener("click", () => act("/stop", { stopped: 1 }));

const KEYS = {
  ArrowLeft: () => answer("left"),
  ArrowRight: () => answer("right"),
  u: undo,
  r: race,
  f: fullScreen,
  Escape: () => document.fullscreenElement && fullScreen(), // where the browser does not leave by itself
  " ": () => player.toggle(),
  ",": () => player.step(-1),
  ".": () => player.step(1),
};
document.querySelectorAll("[data-preference]").forEach((button, index) => {
  KEYS[index + 1] = () => answer(button.dataset.preference);
});
if (four) KEYS[0] = () => answer("equal");
document.addEventListener("keydown", (event) => {
  if (event.altKey || event.ctrlKey || event.metaKey || event.repeat) return;
  if (event.target.closest("textarea, select")) return;
  byId("keys-box").classList.add("used");
  if (!byId("keys").checked) return;
  const control = event.target.closest("input, button, a, summary"); // has a meaning for some keys
  if (control && (event.key === " " || (event.key.startsWith("Arrow") && control.matches("input")))) return;
  const meant = KEYS[event.key] ?? KEYS[event.key?.toLowerCase()];
  if (!meant) return;
  event.preventDefault();
  meant();
});

let wishTimer = null;
async function saveWish() {
  clearTimeout(wishTimer);
  wishTimer = null;
  await send("/wish", { wish: byId("wish").value }).catch((error) => showError(error.message));
}
byId("wish").addEventListener("input", () => {
  clearTimeout(wishTimer);
  wishTimer = setTimeout(saveWish, 600);
});
byId("wish").addEventListener("change", saveWish);
window.addEventListener("pagehide", () => {
  if (wishTimer !== null) saveWish();
  for (const [path, body] of Object.entries(unsent)) ask(path, body).catch(() => {});
});

byId("keys").checked = storage.getItem("keys") !== "off";
byId("keys").addEventListener("change", () => {
  storage.setItem("keys", byId("keys").checked ? "on" : "off");
});

// Another tab, or the back button, may have moved the conversation on.
document.addEventListener("visibilitychange", () => {
  if (document.visibilityState === "visible" && !busy) start();
});

async function start() {
  busy = true;
  for (const [path, body] of Object.entries(unsent)) {
    if (path === "/wish") byId("wish").value = body.wish;
    await send(path, body).catch(() => {}); // refused: the conversation has gone on without it
  }
  await follow();
  busy = false;
}
start();
