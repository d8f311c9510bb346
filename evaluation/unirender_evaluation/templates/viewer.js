// The viewer: a prediction beside the truth or another row's, with a line to drag, or flipped in place.
{
  const viewer = document.querySelector("#viewer"), find = (id) => document.querySelector(`#viewer-${id}`);
  const pairs = all(".compare");
  let here = 0, choices = [];

  const truthOf = (pair) => document.getElementById(pair.dataset.truth);
  const show = () => { // what the two selects say
    for (const [side, select] of [["left", find("a")], ["right", find("b")]]) {
      const choice = choices[select.value];
      find(side).src = choice.image.src;
      find(side).alt = choice.label;
      viewer.querySelector(`.tag.${side}`).textContent = choice.label;
    }
  };
  const slide = () => {
    const at = find("slider").value;
    viewer.style.setProperty("--at", `${at}%`);
    find("slider").setAttribute("aria-valuetext", `${at} percent`);
  };
  const flip = (on) => { // the whole frame is the left picture while it is on
    find("flip").setAttribute("aria-pressed", String(on));
    viewer.classList.toggle("flipped", on);
  };
  const open = (number) => {
    here = (number + pairs.length) % pairs.length;
    const pair = pairs[here], siblings = pairs.filter((other) => other.dataset.truth === pair.dataset.truth);
    choices = [{ label: "truth", image: truthOf(pair) }, ...siblings.map((other) => ({
      label: [other.dataset.row, other.dataset.score].filter(Boolean).join(", "), image: other.querySelector("img"),
    }))];
    for (const select of [find("a"), find("b")]) {
      select.replaceChildren(...choices.map((choice, i) => new Option(choice.label, String(i))));
    }
    find("a").value = "0";
    find("b").value = String(1 + siblings.indexOf(pair));
    find("title").textContent = [pair.dataset.what,
      ...[...pair.closest(".card").querySelector("h4").childNodes].map((node) => node.textContent.trim())].filter(Boolean).join(" · ");
    flip(false);
    show();
    slide();
    if (!viewer.open) viewer.showModal();
    find("slider").focus();
  };

  pairs.forEach((pair, i) => {
    let pressed = 0;
    pair.tabIndex = 0;
    pair.setAttribute("role", "button");
    pair.setAttribute("aria-label", `Compare ${pair.dataset.row} with the truth`);
    pair.addEventListener("pointerdown", (event) => { pressed = event.timeStamp; });
    pair.addEventListener("click", (event) => { if (event.timeStamp - pressed < 400) open(i); }); // longer: it was held
    pair.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      open(i);
    });
  });
  if (viewer) {
    const stage = viewer.querySelector(".stage");
    const drag = (event) => {
      if (event.type === "pointerdown") stage.setPointerCapture(event.pointerId);
      if (!event.buttons) return;
      const box = stage.getBoundingClientRect();
      find("slider").value = String(100 * (event.clientX - box.left) / box.width);
      slide();
    };
    stage.addEventListener("pointerdown", drag);
    stage.addEventListener("pointermove", drag);
    find("slider").addEventListener("input", slide);
    find("a").addEventListener("change", show);
    find("b").addEventListener("change", show);
    find("flip").addEventListener("click", () => flip(!viewer.classList.contains("flipped")));
    find("back").addEventListener("click", () => open(here - 1));
    find("next").addEventListener("click", () => open(here + 1));
    find("close").addEventListener("click", () => viewer.close());
    viewer.addEventListener("click", (event) => { if (event.target === viewer) viewer.close(); });
    viewer.addEventListener("keydown", (event) => {
      if (event.key.toLowerCase() === "f" && event.target.tagName !== "SELECT") flip(!viewer.classList.contains("flipped"));
    });
  }
}
