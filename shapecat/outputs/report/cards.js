// The gallery of cards: their content, filter and order. Also the table of corrections.
const gallery = byId("gallery");
const cards = [...gallery.querySelectorAll(".card")];
const byTrack = new Map(cards.map((card) => [card.dataset.track, card]));
const hiddenCategories = new Set();

function cardOf(track) { return byTrack.get(track); }

function showCard(card) {
  if (!card) return;
  const track = card.dataset.track, label = labelOf(track), category = card.dataset.category;
  const changed = label !== "" && label !== category;
  card.classList.toggle("changed", changed);
  card.classList.toggle("confirmed", label === category);
  card.classList.toggle("deleted", label === "delete");
  const fix = card.querySelector(".fix");
  fix.hidden = label === "";
  fix.textContent = changed ? `→ ${label}` : label ? "✓" : "";
  const verdict = changed ? `, corrected: ${label}` : label ? ", confirmed" : "";
  card.setAttribute("aria-label", `#${track} ${category} ${card.querySelector(".sure").textContent}${verdict}`);
  let named = false;
  for (const button of card.querySelectorAll("[data-label]")) {
    const pressed = button.dataset.label === label;
    button.setAttribute("aria-pressed", String(pressed));
    named = named || pressed;
  }
  const other = card.querySelector(".other");
  other.defaultValue = named ? "" : label;
  if (document.activeElement !== other) restore(other);
}

// Replace the typed text in a text field by the label.
function restore(other) {
  other.value = other.defaultValue;
  other.setCustomValidity("");
}

// Give the track the label that was typed into its text field; return whether it is valid.
function take(other) {
  if (other.value !== other.defaultValue) {
    const label = known(other.value.normalize("NFC").trim().replace(/\s+/g, " "));
    const wrong = setLabel(other.closest(".card").dataset.track, label);
    if (!wrong) restore(other);
    other.setCustomValidity(wrong);
  }
  return other.reportValidity();
}

function fits(card) {
  const label = labelOf(card.dataset.track);
  const state = byId("state").value;
  if (hiddenCategories.has(categoryOf(card.dataset.track))) return false;
  if (Number(card.dataset.confidence) * 100 > Number(byId("confidence").value)) return false;
  if (state === "open") return label === "";
  if (state === "checked") return label !== "";
  return state === "all" || (label !== "" && label !== card.dataset.category);
}

function filter() {
  byId("limit").textContent = (Number(byId("confidence").value) / 100).toFixed(2);
  let count = 0;
  for (const card of cards) {
    card.hidden = !fits(card);
    count += card.hidden ? 0 : 1;
  }
  byId("shown").textContent = `${count} of ${cards.length} ${cards.length === 1 ? "card" : "cards"}`;
  byId("empty").hidden = count > 0;
  // Keys act on the current card, which must not be hidden.
  if (!current || current.hidden) makeCurrent([...gallery.children].find((card) => !card.hidden));
}

function order() {
  const how = byId("order").value;
  const sorted = [...cards];
  if (how === "time") sorted.sort((a, b) => a.dataset.first - b.dataset.first);
  if (how === "category") {
    sorted.sort((a, b) => categoryOf(a.dataset.track).localeCompare(categoryOf(b.dataset.track)));
  }
  gallery.append(...sorted);
}

// Count the tracks as count_cards in cards.py does: merged ones once, deleted ones not.
function recount() {
  const tracks = cards.map((card) => card.dataset.track);
  const objects = [...new Set(tracks.map(shownTrack))].filter((track) => labelOf(track) !== "delete");
  const counts = new Map([...byId("categories").children].map((chip) => [chip.dataset.category, 0]));
  for (const name of objects.map(categoryOf)) counts.set(name, (counts.get(name) || 0) + 1);
  for (const [name, count] of counts) chipOf(name).querySelector("b").textContent = count;
  showTile("tracks", objects.length);
  showTile("uncertain", cards.filter((card) => labels.get(card.dataset.track) === "" && card.dataset.unsure).length);
}

// Return the filter of a category; make one for a new category.
function chipOf(name) {
  const chips = byId("categories");
  const found = [...chips.children].find((chip) => chip.dataset.category === name);
  if (found) return found;
  const made = chips.children[0].cloneNode(true);
  made.dataset.category = name;
  made.setAttribute("aria-pressed", "true");
  made.style.setProperty("--c", data.colours[name] || "#fff");
  made.replaceChildren(made.querySelector(".dot"), name, " ", made.querySelector("b"));
  chips.append(made);
  return made;
}

function showTile(name, value) {
  const title = [...document.querySelectorAll(".tiles dt")].find((one) => one.textContent === name);
  title.nextElementSibling.textContent = value;
}

function element(name, text, className) {
  const made = document.createElement(name);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

function shownAs(row) {
  const label = labelOf(row.track);
  return MERGE.test(label) ? "merged" : label === "delete" ? "deleted" : label;
}

function summarize() {
  const checked = data.rows.filter((row) => labels.get(row.track) !== "");
  const right = checked.filter((row) => labelOf(row.track) === row.category).length;
  byId("download").textContent = checked.length ? `Download table (${checked.length})` : "Download table";
  byId("verdict").textContent = checked.length
    ? `${right} of ${checked.length} checked ${checked.length === 1 ? "track was" : "tracks were"} right. Rows: detected category; columns: your label.`
    : "To confirm or correct a track, press a digit, or click a category on its card.";
  byId("confusion").replaceChildren(...(checked.length ? [confusion(checked)] : []));
  recount();
}

function confusion(checked) {
  const rank = (name) => (data.categories.includes(name) ? data.categories.indexOf(name) : 999);
  const sort = (names) => [...new Set(names)].sort((a, b) => rank(a) - rank(b) || a.localeCompare(b));
  const columns = sort(checked.map(shownAs));
  const table = element("table", "", "confusion");
  table.insertRow().append(element("th", ""), ...columns.map((name) => element("th", name)));
  for (const name of sort(checked.map((row) => row.category))) {
    const line = table.insertRow();
    line.append(element("th", name));
    for (const column of columns) {
      const count = checked.filter((row) => row.category === name && shownAs(row) === column).length;
      line.append(element("td", count || "", count ? (name === column ? "same" : "wrong") : ""));
    }
  }
  return table;
}

function csv() {
  const quote = (cell) => (/[",\r\n]/.test(cell) ? `"${cell.replaceAll('"', '""')}"` : cell);
  // Add the labels that this table replaces, so that it cannot undo labels that were given elsewhere since.
  const lines = data.rows.map((row) => [...data.columns.map((name, k) =>
    quote(name === "label" ? labels.get(row.track) : row.cells[k])), quote(replaced(row.track))].join(","));
  const text = [[...data.columns, "label_seen"].map(quote).join(","), ...lines, ""].join("\n");
  // Without a byte order mark, Excel would misread letters other than a to z.
  return /^[\x00-\x7f]*$/.test(text) ? text : `\ufeff${text}`;
}

gallery.addEventListener("click", (event) => {
  const button = event.target.closest("button[data-label]");
  if (!button) return;
  const pressed = button.getAttribute("aria-pressed") === "true";
  setLabel(button.closest(".card").dataset.track, pressed ? "" : button.dataset.label);
});
gallery.addEventListener("change", (event) => event.target.matches(".other") && take(event.target));
gallery.addEventListener("input", (event) => {
  if (event.target.matches(".other")) event.target.setCustomValidity("");
});
byId("categories").addEventListener("click", (event) => {
  const chip = event.target.closest(".chip");
  if (!chip) return;
  const shown = chip.getAttribute("aria-pressed") === "true";
  chip.setAttribute("aria-pressed", String(!shown));
  if (shown) hiddenCategories.add(chip.dataset.category); else hiddenCategories.delete(chip.dataset.category);
  filter();
});
byId("confidence").addEventListener("input", filter);
byId("state").addEventListener("change", filter);
byId("order").addEventListener("change", order);
byId("undo").addEventListener("click", undo);
byId("meshes").addEventListener("change", (event) =>
  document.body.classList.toggle("meshes", event.target.checked));
byId("download").addEventListener("click", () => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([csv()], { type: "text/csv" }));
  // Each download has its own name: the browser would rename a second tracks.csv, and the command would read the first.
  link.download = `tracks-${new Date().toLocaleString("sv").replace(/\D/g, "")}.csv`;
  const command = byId("command");
  command.textContent = `${command.dataset.annotate} --labels ~/Downloads/${link.download}`;
  link.click();
  noteDownload();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
});
