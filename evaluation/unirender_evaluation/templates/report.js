"use strict";
// Everything below is a convenience: without it the page shows all tables and pictures.
const all = (selector, root = document) => [...root.querySelectorAll(selector)];

for (const block of all(".block")) { // variants of one table as tabs
  const panels = all(".panel", block), tabs = all(".tabs button", block);
  const show = (i) => {
    panels.forEach((panel, k) => { panel.hidden = k !== i; });
    tabs.forEach((tab, k) => {
      tab.setAttribute("aria-selected", String(k === i));
      tab.tabIndex = k === i ? 0 : -1;
    });
  };
  tabs.forEach((tab, i) => {
    tab.addEventListener("click", () => show(i));
    tab.addEventListener("keydown", (event) => { // the Tab key stops at one of them, arrows go on to the others
      const last = tabs.length - 1;
      const to = { ArrowRight: i < last ? i + 1 : 0, ArrowLeft: i > 0 ? i - 1 : last, Home: 0, End: last }[event.key];
      if (to === undefined) return;
      event.preventDefault();
      show(to);
      tabs[to].focus();
    });
  });
  if (tabs.length) show(0);
}
document.documentElement.classList.add("tabbed"); // tabs work: the panels need no headings of their own on a screen

for (const table of all("table.data:not(#sample-rows)")) { // sort inside sections, so that bounds stay bounds
  const heads = all("thead tr:last-child th", table);
  heads.forEach((head, i) => head.querySelector("button")?.addEventListener("click", () => {
    const descending = head.getAttribute("aria-sort") !== "descending";
    heads.forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", descending ? "descending" : "ascending");
    for (const body of table.tBodies) {
      const value = (row) => parseFloat(row.cells[i].dataset.v);
      const order = (a, b) => {
        const [x, y] = [value(a), value(b)];
        if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y);
        return descending ? y - x : x - y;
      };
      body.append(...all("tr", body).sort(order));
    }
  }));
}

for (const pair of all(".compare")) { // hold a prediction to see the truth in its place
  const hold = (on) => () => {
    if (on && !pair.querySelector(".over")) {
      const over = document.getElementById(pair.dataset.truth).cloneNode();
      over.removeAttribute("id");
      over.classList.add("over");
      pair.append(over);
    }
    pair.classList.toggle("held", on);
  };
  pair.addEventListener("pointerenter", hold(true));
  pair.addEventListener("pointerdown", hold(true));
  for (const end of ["pointerleave", "pointerup", "pointercancel"]) pair.addEventListener(end, hold(false));
}

document.querySelector("#flip")?.addEventListener("change", (event) =>
  document.body.classList.toggle("noflip", !event.target.checked));
document.querySelector("#which")?.addEventListener("change", (event) => {
  for (const shelf of all(".shelf")) shelf.hidden = !["", shelf.dataset.which].includes(event.target.value);
});

document.querySelector("#theme")?.addEventListener("click", () => {
  const root = document.documentElement, dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const now = root.dataset.theme ?? (dark ? "dark" : "light");
  root.dataset.theme = now === "dark" ? "light" : "dark";
});
const save = (text, name) => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
};
document.querySelector("#download")?.addEventListener("click", () =>
  save(document.querySelector("#tables-json").textContent, "tables.json"));
