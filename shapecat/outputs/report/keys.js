// The keyboard: keys act on the current card.
let current = null;

function makeCurrent(card) {
  for (const [one, index] of [[current, -1], [card, 0]]) {
    if (!one) continue;
    one.tabIndex = index;
    for (const control of one.querySelectorAll("button, input, a")) control.tabIndex = index;
  }
  current = card;
}

function enter(track) {
  const card = cardOf(track);
  if (!card) return;
  card.hidden = false;
  card.focus({ preventScroll: true });
  card.scrollIntoView({ block: "nearest" });
}

function showDigits() {
  const names = data.categories.slice(0, 10).map((name, digit) => {
    const item = element("span", "");
    item.append(element("kbd", digit), ` ${name}`);
    return item;
  });
  byId("digits").replaceChildren(...names.slice(1), ...names.slice(0, 1));
}

function move(key) {
  const shown = [...gallery.children].filter((card) => !card.hidden);
  const columns = shown.filter((card) => card.offsetTop === shown[0].offsetTop).length;
  const step = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -columns, ArrowDown: columns }[key];
  const next = shown[shown.indexOf(current) + step];
  if (next) enter(next.dataset.track);
}

function write(text) {
  const other = current.querySelector(".other");
  other.focus();
  other.value = text || other.value;
}

const actions = {
  Delete: () => setLabel(current.dataset.track, "delete"),
  d: () => setLabel(current.dataset.track, "delete"),
  Backspace: () => setLabel(current.dataset.track, ""),
  n: () => write(""),
  m: () => write("merge with #"),
  u: undo,
  f: () => openFrameOf(current.dataset.track),
};

function act(event) {
  const digit = /^\d$/.test(event.key) ? data.categories[Number(event.key)] : undefined;
  if (digit !== undefined) setLabel(current.dataset.track, digit);
  else if (event.key.startsWith("Arrow")) move(event.key);
  else if (event.key === "Enter" && event.target === current) setLabel(current.dataset.track, current.dataset.category);
  else if (actions[event.key]) actions[event.key]();
  else return;
  event.preventDefault();
}

addEventListener("keydown", (event) => {
  const field = event.target.matches("input, select, textarea");
  if (large.open || !current) return;
  if (field) {
    const leaves = event.target.matches(".other") && ["Escape", "Enter"].includes(event.key);
    if (!leaves || event.isComposing) return;
    event.preventDefault();
    if (event.key === "Escape") restore(event.target);
    if (event.key === "Escape" || take(event.target)) enter(current.dataset.track);
  } else if ((event.ctrlKey || event.metaKey) && event.key === "z") {
    event.preventDefault();
    undo();
  } else if (!event.ctrlKey && !event.metaKey && !event.altKey
      && (event.target === document.body || gallery.contains(event.target))) {
    act(event);
  }
});
gallery.addEventListener("focusin", (event) => makeCurrent(event.target.closest(".card")));

for (const control of gallery.querySelectorAll("button, input, a")) control.tabIndex = -1;
for (const row of data.rows) { showCard(cardOf(row.track)); showBoxes(row.track); }
new ResizeObserver(() =>
  document.body.style.setProperty("--bar", `${byId("bar").offsetHeight}px`)).observe(byId("bar"));
showDigits();
filter();
summarize();
showSaved();
if (current && !location.hash) current.focus({ preventScroll: true });
