// The labels of the tracks on this page, and the undo of the last one.
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const labels = new Map(data.rows.map((row) => [row.track, row.label]));
const past = [];

// Return a label in its usual spelling: `Delete` and `CUP` become `delete` and `cup`.
function known(label) {
  const found = ["delete", ...data.categories].find((name) => name.toLowerCase() === label.toLowerCase());
  return found === undefined ? label : found;
}

// Return the label of a track in its usual spelling, and without `new`: `pan` for `new pan`.
function labelOf(track) { return known(labels.get(track).replace(NEW, "$1")); }

// Return the track as which a track is shown: itself, or the one at the end of its merges.
function shownTrack(track) {
  let end = track;
  for (const _ of data.rows) {  // a table from elsewhere may hold a loop
    const merge = labels.get(end).match(MERGE);
    if (!merge || !labels.has(merge[1])) break;
    end = merge[1];
  }
  return end;
}

// Return the category that a track has with its label; a deleted track keeps its own.
function categoryOf(track) {
  const end = shownTrack(track), label = labelOf(end);
  return label && label !== "delete" ? label : data.rows.find((row) => row.track === end).category;
}

function say(text, bad = false) {
  byId("said").textContent = text;
  byId("said").classList.toggle("bad", bad);
}

function inWords(track, label) {
  return label === "" ? `#${track}: label cleared` : `#${track}: ${label}`;
}

function learn(label) {
  if (!label || label === "delete" || MERGE.test(label) || known(label) !== label) return;
  if (!data.categories.includes(label)) data.categories.push(label);
  showDigits();
}

// Give a track a label; if the label is invalid, change nothing and return the problem.
function setLabel(track, label) {
  const before = labels.get(track);
  if (before === label) return "";
  const wrong = problem(track, label);
  if (wrong) { say(`#${track}: ${wrong}`, true); return wrong; }
  past.push([track, before]);
  put(track, label);
  return "";
}

function put(track, label) {
  labels.set(track, label);
  learn(label);
  say(inWords(track, label));
  refresh(track);
  save(track);
}

function undo() {
  const step = past.pop();
  if (!step) return say("Nothing to undo.");
  put(...step);
  say(`Undone. ${inWords(...step)}`);
  enter(step[0]);
}

function forget(track) {
  for (let k = past.length - 1; k >= 0; k--) if (past[k][0] === track) past.splice(k, 1);
}

function refresh(track) {
  showCard(cardOf(track));
  showBoxes(track);
  summarize();
  byId("undo").disabled = past.length === 0;
}
