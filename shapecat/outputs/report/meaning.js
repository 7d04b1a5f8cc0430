// Check labels by the rules of runs/labels/meaning.py, since `annotate` refuses a table with an invalid label.
const MERGE = /^merged? +(?:with|into) +#?0*(\d{1,9})(?:[.,]0*)?$/i;
const NEW = /^new +(.+)$/i;
const NAME = /^(?!\p{Nd})[\p{L}\p{N}](?:[\p{L}\p{N}_ .+&'()-]{0,58}[\p{L}\p{N}_)])?$/u;

// Return the problem if a label would be invalid for a track, or would make the label of another track invalid.
function problem(track, label) {
  const before = problems(labels), after = problems(new Map(labels).set(track, label));
  if (after.has(track)) return after.get(track);
  for (const [other, reason] of after) if (!before.has(other)) return `#${other}: ${reason}`;
  return "";
}

// Return the problem of each invalid label, by track.
function problems(given) {
  const names = new Set([...data.known, ...data.rows.map((row) => row.category)].map((name) => name.toLowerCase()));
  const found = new Map();
  const newFirst = (a, b) => NEW.test(given.get(b)) - NEW.test(given.get(a));
  for (const track of data.rows.map((row) => row.track).sort(newFirst)) {
    const reason = misread(given.get(track), names) || misled(track, given);
    if (reason) found.set(track, reason);
  }
  return found;
}

// Return the problem of a label without a meaning. Add a new category to the known names.
function misread(label, names) {
  const lower = label.toLowerCase();
  if (!label || lower === "delete" || names.has(lower) || MERGE.test(label)) return "";
  const name = label.replace(NEW, "$1").toLowerCase();
  if (/^(merged?( |\W*\d|$)|(del(ete)?|remove|none|dontcare|na|nan|null)$)/.test(name)) {
    return "Write a category, delete, or merge with #3.";
  }
  if (!NAME.test(name.replace(/\p{M}/gu, ""))) {
    return "A name begins with a letter, ends with a letter, a digit, _ or ), and has at most 60 letters, digits, spaces and - _ . + & ' ( )";
  }
  const allowed = (other) => (Math.min(name.length, other.length) < 5 ? 1 : 2);
  const plain = name.normalize("NFKC"); // full-width letters look like the others
  const number = plain.match(/\d{1,9}$/), commands = ["delete", ...(number ? [`merge with ${Number(number)}`] : [])];
  const near = !NEW.test(label) && [...names, ...commands].find((other) => slips(plain, other) <= allowed(other));
  if (near) return `Did you mean ${near}? For a new category write: new ${label}`;
  names.add(name);
  return "";
}

// Return the problem if a track cannot be merged as its label says.
function misled(track, given) {
  const chain = [track];
  for (let merge; (merge = given.get(chain.at(-1)).match(MERGE)); chain.push(merge[1])) {
    if (!given.has(merge[1])) return `There is no track #${merge[1]}.`;
    if (chain.includes(merge[1])) return `The merges form a loop: #${[...chain, merge[1]].join(" → #")}`;
    if (given.get(merge[1]).toLowerCase() === "delete") return `#${merge[1]} is deleted.`;
  }
  if (data.oneFrame || chain.length === 1) return "";
  const [own, other] = [track, chain.at(-1)].map(topics);
  return own.some((topic) => other.includes(topic)) ? "" : `#${chain.at(-1)} belongs to another topic.`;
}

function topics(track) {
  const { cells } = data.rows.find((row) => row.track === track);
  return (cells[data.columns.indexOf("topic")] || "").trim().split(/\s+/);
}

// Return the edit distance: the number of letters added, dropped, changed or swapped.
function slips(a, b) {
  let before, last = [...Array(b.length + 1).keys()];
  for (let i = 1; i <= a.length; i++) {
    const row = [i];
    for (let j = 1; j <= b.length; j++) {
      row.push(Math.min(last[j] + 1, row[j - 1] + 1, last[j - 1] + (a[i - 1] === b[j - 1] ? 0 : 1)));
      if (i > 1 && j > 1 && a[i - 1] === b[j - 2] && a[i - 2] === b[j - 1]) row[j] = Math.min(row[j], before[j - 2] + 1);
    }
    [before, last] = [last, row];
  }
  return last[b.length];
}
