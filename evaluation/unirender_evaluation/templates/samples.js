// The table of samples: a line each, a column for every row of the tables, opened to all numbers and pictures.
{
  const sections = JSON.parse(document.querySelector("#samples-json").textContent);
  const find = (id) => document.querySelector(`#sample-${id}`);
  const make = (tag, properties = {}, ...children) => {
    const { data, ...rest } = properties, element = Object.assign(document.createElement(tag), rest);
    Object.assign(element.dataset, data ?? {});
    element.append(...children);
    return element;
  };
  const number = (value) => value === "inf" ? Infinity : value === "-inf" ? -Infinity : value ?? NaN;
  const text = (value, column) => {
    const x = number(value);
    return Number.isNaN(x) ? "-" : Number.isFinite(x) ? x.toFixed(column.digits) : x > 0 ? "∞" : "-∞";
  };
  let section, column, sorted; // sorted: {by: -1 = name, else row number; descending}

  const heading = (label, by, kind) => {
    const button = make("button", { type: "button", textContent: label });
    const head = make("th", { scope: "col" }, button);
    if (kind) button.prepend(make("span", { className: `dot k-${kind}` }));
    if (sorted.by === by) head.setAttribute("aria-sort", sorted.descending ? "descending" : "ascending");
    button.addEventListener("click", () => {
      const first = by < 0 ? false : !section.columns[column].higher; // worst first
      sorted = { by, descending: sorted.by === by ? !sorted.descending : first };
      draw();
    });
    return head;
  };

  const details = (sample) => { // all numbers of a sample, and its pictures
    const inner = make("div", { className: "opened" });
    if (sample.sheet) {
      const { uri, width, height, names, method, caption } = sample.sheet;
      inner.append(make("figure", { className: "sheet" },
        make("img", { className: "pic", src: uri, width, height, alt: `truth above, ${method} below`,
          style: `width: ${width * (width < 500 ? 2 : 1)}px` }),
        make("figcaption", { textContent: `${names.join(", ")}: truth above, ${method} below. ${caption}` })));
    } else inner.append(make("p", { className: "protocol", textContent: "No pictures of this sample in this page." }));
    const groups = new Map();
    section.columns.forEach((view, i) => groups.set(view.variant, [...groups.get(view.variant) ?? [], i]));
    for (const [variant, columns] of groups) {
      const used = columns.filter((i) => sample.values.some((row) => row && row[i] !== null));
      const rows = section.methods.map((method, m) => [method, sample.values[m]]).filter(([, row]) =>
        row && used.some((i) => row[i] !== null));
      if (!rows.length) continue;
      inner.append(make("table", { className: "data" },
        make("caption", { textContent: variant }),
        make("thead", {}, make("tr", {}, make("th", { scope: "col", textContent: "Method" }), ...used.map((i) => {
          const view = section.columns[i];
          return make("th", { scope: "col", title: view.key, textContent: `${view.text}${view.unit ? ` (${view.unit})` : ""} ${view.arrow}` });
        }))),
        make("tbody", {}, ...rows.map(([method, row]) => make("tr", {},
          make("th", { scope: "row" }, make("span", { className: `dot k-${method.kind}` }), method.label),
          ...used.map((i) => make("td", { textContent: text(row[i], section.columns[i]) })))))));
    }
    return inner;
  };

  const line = (sample, methods) => {
    const open = make("button", { type: "button", className: "open", textContent: sample.id });
    open.setAttribute("aria-expanded", "false");
    const row = make("tr", { data: { sample: sample.id } }, make("th", { scope: "row" }, open), ...methods.map((m) => {
      const value = sample.values[m]?.[column];
      return make("td", { textContent: text(value, section.columns[column]), data: { v: String(number(value)) } });
    }));
    open.addEventListener("click", () => {
      const shown = row.nextElementSibling?.classList.contains("details");
      open.setAttribute("aria-expanded", String(!shown));
      if (shown) row.nextElementSibling.remove();
      else row.after(make("tr", { className: "details" }, make("td", { colSpan: row.cells.length }, details(sample))));
    });
    return row;
  };

  const draw = () => {
    const wanted = find("find").value.trim().toLowerCase();
    const methods = section.methods.map((_, m) => m).filter((m) => section.samples.some((s) =>
      (s.values[m]?.[column] ?? null) !== null));
    const asked = section.samples.filter((s) => methods.some((m) => (s.values[m]?.[column] ?? null) !== null));
    const samples = asked.filter((s) => `${s.id} ${s.object}`.toLowerCase().includes(wanted));
    const value = (sample) => sorted.by < 0 ? sample.id : number(sample.values[sorted.by]?.[column]);
    samples.sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      if (sorted.by < 0) return (sorted.descending ? -1 : 1) * (x < y ? -1 : x > y ? 1 : 0);
      if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y);
      return x === y ? 0 : (sorted.descending ? y > x : x > y) ? 1 : -1;
    });
    find("rows").replaceChildren(
      make("thead", {}, make("tr", {}, heading("Sample", -1),
        ...methods.map((m) => heading(section.methods[m].label, m, section.methods[m].kind)))),
      make("tbody", {}, ...samples.map((sample) => line(sample, methods))));
    find("count").textContent = `${samples.length} of ${asked.length} samples`;
  };

  const choose = () => { // another number: the worst samples of the first row that has it come first
    column = Number(find("column").value);
    const first = section.methods.findIndex((_, m) => section.samples.some((s) => (s.values[m]?.[column] ?? null) !== null));
    sorted = { by: first, descending: !section.columns[column].higher };
    draw();
  };
  const enter = () => {
    section = sections[Number(find("table").value)];
    find("column").replaceChildren(...section.columns.flatMap((view, i) =>
      section.samples.some((s) => s.values.some((row) => row && row[i] !== null))
        ? [new Option(`${view.text} ${view.arrow}, ${view.variant}`, String(i))] : []));
    choose();
  };

  if (sections.length) {
    find("tools").hidden = false;
    find("table").addEventListener("change", enter);
    find("column").addEventListener("change", choose);
    find("find").addEventListener("input", draw);
    enter();
  }
  document.querySelector("#download-samples")?.addEventListener("click", () => save(
    JSON.stringify(sections.map((s) => ({ ...s, samples: s.samples.map(({ sheet, ...rest }) => rest) }))), "samples.json"));
}
