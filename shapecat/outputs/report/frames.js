// The strip of frames, with the boxes and labels of tracks, and the enlarged frame.
const frames = [...document.querySelectorAll(".frame")];
const large = byId("large");
let open = 0;

function showBoxes(track) {
  const row = data.rows.find((one) => one.track === track);
  const label = labelOf(track), merge = label.match(MERGE);
  const category = label && !merge && label !== "delete" ? label : row.category;
  for (const box of document.querySelectorAll(`.box[data-track="${track}"]`)) {
    box.classList.toggle("deleted", label === "delete");
    box.style.setProperty("--c", data.colours[category] || "#fff");
    box.querySelector("i").textContent = merge ? ` → #${merge[1]}` : ` ${category}`;
  }
}

// Move labels that would cover each other down by their height.
function spread(shot) {
  const placed = [];
  const captions = [...shot.querySelectorAll(".box b")];
  captions.sort((a, b) => a.getBoundingClientRect().top - b.getBoundingClientRect().top);
  for (const caption of captions) {
    const covers = (other) => {
      const a = caption.getBoundingClientRect(), b = other.getBoundingClientRect();
      return a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
    };
    for (let step = 1; step < 8 && placed.some(covers); step++) caption.style.translate = `0 ${100 * step}%`;
    placed.push(caption);
  }
}

function openFrame(number, track) {
  if (!frames.length) return say("There are no frames to show.");
  open = (number + frames.length) % frames.length;
  const shot = frames[open].querySelector(".shot").cloneNode(true);
  for (const box of shot.querySelectorAll(".box")) box.classList.toggle("chosen", box.dataset.track === track);
  shot.style.setProperty("--ratio", frames[open].style.getPropertyValue("--ratio"));
  byId("stage").replaceChildren(shot);
  byId("where").textContent = `${frames[open].dataset.name} (${open + 1} of ${frames.length})`;
  if (!large.open) large.showModal();
  spread(shot);
}

// Return the index of the frame in which a track has the largest box; -1 if no frame shows it.
function frameOf(track) {
  const sizes = frames.map((frame) => {
    const box = frame.querySelector(`.box[data-track="${track}"]`);
    return box ? parseFloat(box.style.width) * parseFloat(box.style.height) : 0;
  });
  return Math.max(...sizes, 0) > 0 ? sizes.indexOf(Math.max(...sizes)) : -1;
}

function openFrameOf(track) {
  const number = frameOf(track);
  if (number < 0) say(`#${track} is in none of these frames.`); else openFrame(number, track);
}

frames.forEach((frame, number) => frame.addEventListener("click", () => openFrame(number)));
byId("before").addEventListener("click", () => openFrame(open - 1));
byId("after").addEventListener("click", () => openFrame(open + 1));
byId("stage").addEventListener("click", (event) => {
  const box = event.target.closest(".box");
  if (!box) return;
  large.close();
  enter(box.dataset.track);
});
large.addEventListener("keydown", (event) => {
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (step) openFrame(open + step);
});
gallery.addEventListener("click", (event) => {
  if (event.target.closest(".crop")) openFrameOf(event.target.closest(".card").dataset.track);
});
