// The labels of the tracks as this page has them, and how to undo the last.
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const MERGE = /^merged? +(?:with|into) +#?(\d+)$/i;
const labels = new Map(data.rows.map((row) => [row.track, row.label]));
const past = [];

function known(name) {
  const found = data.categories.find((category) => category.toLowerCase() === name.toLowerCase());
  return found === undefined ? name : found;
}

function problem(track, label) {
  const merge = label.match(MERGE);
  if (merge && merge[1] === track) return `A track cannot be merged with itself.`;
  if (merge && !labels.has(merge[1])) return `There is no track #${merge[1]}.`;
  if (!merge && /^merged? /i.test(label)) return "Write: merge with #3";
  if (!merge && label && !/^\p{L}/u.test(label)) return "A name begins with a letter.";
  if (/[\/\\:*?"<>|,;]/.test(label)) return "Use only letters, digits, spaces and - _ . + & ' ( )";
  return "";
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

function setLabel(track, label) {
  const before = labels.get(track);
  if (before === label) return;
  past.push([track, before]);
  put(track, label);
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
