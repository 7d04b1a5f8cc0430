// Save labels: the server writes them to tracks.csv, or this browser keeps them until they are downloaded.
const storage = `shapecat:${data.key}`;
const onDisk = new Map(labels);
const given = new Map();  // corrections in downloaded tables, which may be in tracks.csv by now
const sending = new Set();
let lost = "", before = Promise.resolve();

function save(track) {
  if (data.served) send(track); else keep(track);
}

// Store a correction, and the label that it replaces, beside the corrections of other tabs.
function keep(track) {
  try {
    const all = kept(), [label, seen] = [labels.get(track), onDisk.get(track)];
    if (label === seen && !given.has(track)) delete all[track]; else all[track] = [label, seen, given.get(track)];
    localStorage.setItem(storage, JSON.stringify(all));
  } catch { /* Some browsers store nothing for local files; the download still works. */ }
}

// Return the stored corrections, without those of labels that have changed on disk since.
function kept() {
  const all = Object.entries(JSON.parse(localStorage.getItem(storage) || "{}"));
  return Object.fromEntries(all.filter(([track, [, seen]]) => onDisk.get(track) === seen));
}

function recall() {
  try {
    for (const [track, [label, , told]] of Object.entries(kept())) {
      labels.set(track, label);
      if (typeof told === "string") given.set(track, told);
      learn(label);
    }
  } catch { /* The browser stores nothing for local files. */ }
}

function unsaved() {
  return data.rows.map((row) => row.track).filter((track) => labels.get(track) !== onDisk.get(track));
}

// Return the label that a downloaded table replaces.
function replaced(track) {
  const seen = onDisk.get(track);
  return labels.get(track) === seen && given.has(track) ? given.get(track) : seen;
}

function noteDownload() {
  for (const track of unsaved()) {
    given.set(track, labels.get(track));
    if (!data.served) keep(track);
  }
}

// Take over the labels that other tabs and programs wrote, unless this page has a newer one.
function adopt(disk) {
  for (const [track, label] of Object.entries(disk)) {
    if (!labels.has(track) || onDisk.get(track) === label) continue;
    const untouched = labels.get(track) === onDisk.get(track);
    onDisk.set(track, label);
    if (untouched) { labels.set(track, label); forget(track); learn(label); refresh(track); }
  }
}

// Send one request at a time: an answer that arrives late would undo what a newer one reported.
function ask(options) {
  const turn = before.then(() => request(options));
  before = turn.catch(() => {});
  return turn;
}

async function request(options) {
  const reply = await fetch("labels", options).catch(() => { throw new Error("the server does not answer"); });
  if (!reply.ok && reply.status !== 409) throw new Error(await reply.text());
  return [reply.ok, await reply.json()];
}

// Send the newest label of a track until it is in tracks.csv. The server refuses it if the label in
// tracks.csv is not the one that this page knows.
async function send(track) {
  if (sending.has(track)) return;
  sending.add(track);
  try {
    while (labels.get(track) !== onDisk.get(track)) {
      showSaved();
      const label = labels.get(track), wanted = { track: Number(track), label, seen: onDisk.get(track) };
      const headers = { "Content-Type": "application/json" };
      const [done, answer] = await ask({ method: "POST", keepalive: true, headers, body: JSON.stringify(wanted) });
      if (done) onDisk.set(track, label);
      adopt(answer.labels);
      if (!done) refuse(track, answer.problem);
      if (lost) sendAgain();
    }
  } catch (error) { lost = error.message; }
  sending.delete(track);
  showSaved();
}

function refuse(track, reason) {
  labels.set(track, onDisk.get(track));
  forget(track);
  refresh(track);
  say(`#${track} was not changed: ${reason}`, true);
}

function showSaved() {
  const left = unsaved().length, one = left === 1;
  byId("download").hidden = data.served && lost === "";
  byId("saved").classList.toggle("bad", lost !== "" && left > 0);
  if (!data.served) {
    byId("saved").textContent = "Corrections stay in this browser until you download them.";
  } else if (!left) {
    byId("saved").textContent = "All corrections are in tracks.csv.";
  } else {
    byId("saved").textContent = lost
      ? `${left} ${one ? "correction is" : "corrections are"} not saved: ${lost}. Download the table to keep ${one ? "it" : "them"}.`
      : "Saving …";
  }
}

// Send the labels that the server did not get, now that it answers again.
function sendAgain() {
  lost = "";
  for (const track of unsaved()) send(track);
}

async function catchUp() {
  try { adopt((await ask())[1].labels); sendAgain(); } catch (error) { lost = error.message; }
  showSaved();
}

if (data.served) {
  addEventListener("focus", catchUp);
  addEventListener("beforeunload", (event) => { if (unsaved().length) event.preventDefault(); });
  setInterval(() => { if (lost && unsaved().length) catchUp(); }, 2000);
} else {
  recall();
}
