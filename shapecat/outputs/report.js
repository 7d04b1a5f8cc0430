"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const gallery = byId("gallery");
  const cards = [...gallery.querySelectorAll(".card")];
  const storage = `shapecat:${data.key}`;
  const MERGE = /^merged? +(?:with|into) +#?(\d+)$/i;
  const hiddenCategories = new Set();
  const labels = new Map(data.rows.map((row) => [row.track, row.label]));

  try {
    const kept = JSON.parse(localStorage.getItem(storage) || "{}");
    for (const [track, label] of Object.entries(kept)) if (labels.has(track)) labels.set(track, label);
  } catch { /* a browser that keeps nothing for files still downloads */ }

  function keep() {
    try {
      const changed = data.rows.filter((row) => labels.get(row.track) !== row.label);
      const pairs = changed.map((row) => [row.track, labels.get(row.track)]);
      localStorage.setItem(storage, JSON.stringify(Object.fromEntries(pairs)));
    } catch { /* the same */ }
  }

  function known(name) {
    const found = data.categories.find((category) => category.toLowerCase() === name.toLowerCase());
    return found === undefined ? name : found;
  }

  function problem(track, label) {
    const merge = label.match(MERGE);
    if (merge && merge[1] === track) return "This is the same track.";
    if (merge && !labels.has(merge[1])) return `There is no track ${merge[1]}.`;
    if (!merge && /^merged? /i.test(label)) return "Write: merge with N";
    if (!merge && label && !/^\p{L}/u.test(label)) return "A name begins with a letter.";
    if (/[\/\\:*?"<>|,;]/.test(label)) return "Letters, digits, blanks, - _ . + & ' ( ) only.";
    return "";
  }

  function show(card) {
    const label = labels.get(card.dataset.track);
    const category = card.dataset.category;
    const changed = label !== "" && label !== category;
    card.classList.toggle("changed", changed);
    card.classList.toggle("confirmed", label === category);
    card.classList.toggle("deleted", label === "delete");
    const fix = card.querySelector(".fix");
    fix.hidden = label === "";
    fix.textContent = changed ? `→ ${label}` : "✓";
    let named = false;
    for (const button of card.querySelectorAll("[data-label]")) {
      const pressed = button.dataset.label === label;
      button.setAttribute("aria-pressed", String(pressed));
      named = named || pressed;
    }
    const other = card.querySelector(".other");
    if (document.activeElement !== other) other.value = named ? "" : label;
  }

  function setLabel(card, label) {
    labels.set(card.dataset.track, label);
    show(card);
    keep();
    summarize();
  }

  function fits(card) {
    const label = labels.get(card.dataset.track);
    const state = byId("state").value;
    if (hiddenCategories.has(card.dataset.category)) return false;
    if (Number(card.dataset.confidence) * 100 > Number(byId("confidence").value)) return false;
    if (state === "open") return label === "";
    if (state === "checked") return label !== "";
    return state === "all" || (label !== "" && label !== card.dataset.category);
  }

  function filter() {
    byId("limit").textContent = `${byId("confidence").value} %`;
    let count = 0;
    for (const card of cards) {
      card.hidden = !fits(card);
      count += card.hidden ? 0 : 1;
    }
    byId("shown").textContent = `${count} of ${cards.length} tracks`;
    byId("empty").hidden = count > 0;
  }

  function order() {
    const how = byId("order").value;
    const sorted = [...cards];
    if (how === "time") sorted.sort((a, b) => a.dataset.first - b.dataset.first);
    if (how === "category") sorted.sort((a, b) => a.dataset.category.localeCompare(b.dataset.category));
    gallery.append(...sorted);
  }

  function element(name, text, className) {
    const made = document.createElement(name);
    made.textContent = text;
    if (className) made.className = className;
    return made;
  }

  function shownAs(row) {
    const label = labels.get(row.track);
    return MERGE.test(label) ? "merged" : label === "delete" ? "deleted" : label;
  }

  function summarize() {
    const checked = data.rows.filter((row) => labels.get(row.track) !== "");
    const right = checked.filter((row) => labels.get(row.track) === row.category).length;
    byId("download").textContent = checked.length
      ? `Download tracks.csv (${checked.length})` : "Download tracks.csv";
    if (!checked.length) {
      byId("verdict").textContent = "Click a category on a card to confirm or correct it.";
      byId("confusion").replaceChildren();
      return;
    }
    byId("verdict").textContent =
      `${right} of ${checked.length} tracks looked at were right. Rows: what the model said; columns: what you said.`;
    const rank = (name) => (data.categories.includes(name) ? data.categories.indexOf(name) : 999);
    const sort = (names) => [...new Set(names)].sort((a, b) => rank(a) - rank(b) || a.localeCompare(b));
    const rows = sort(checked.map((row) => row.category));
    const columns = sort(checked.map(shownAs));
    const table = element("table", "", "confusion");
    const head = table.insertRow();
    head.append(element("th", ""), ...columns.map((name) => element("th", name)));
    for (const name of rows) {
      const line = table.insertRow();
      line.append(element("th", name));
      for (const column of columns) {
        const count = checked.filter((row) => row.category === name && shownAs(row) === column).length;
        line.append(element("td", count || "", count ? (name === column ? "same" : "wrong") : ""));
      }
    }
    byId("confusion").replaceChildren(table);
  }

  function csv() {
    const quote = (cell) => (/[",\r\n]/.test(cell) ? `"${cell.replaceAll('"', '""')}"` : cell);
    const lines = data.rows.map((row) => data.columns.map((name, k) =>
      quote(name === "label" ? labels.get(row.track) : row.cells[k])).join(","));
    return [data.columns.map(quote).join(","), ...lines, ""].join("\n");
  }

  gallery.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-label]");
    if (!button) return;
    const card = button.closest(".card");
    const pressed = button.getAttribute("aria-pressed") === "true";
    setLabel(card, pressed ? "" : button.dataset.label);
  });
  gallery.addEventListener("change", (event) => {
    if (!event.target.matches(".other")) return;
    const card = event.target.closest(".card");
    const label = known(event.target.value.trim().replace(/\s+/g, " "));
    const wrong = problem(card.dataset.track, label);
    event.target.setCustomValidity(wrong);
    if (wrong) event.target.reportValidity(); else setLabel(card, label);
  });
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
  byId("graphs").addEventListener("change", (event) =>
    document.body.classList.toggle("graphs", event.target.checked));
  byId("download").addEventListener("click", () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([csv()], { type: "text/csv" }));
    link.download = "tracks.csv";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  });

  cards.forEach(show);
  filter();
  summarize();
  document.body.dataset.ready = "yes";
})();
