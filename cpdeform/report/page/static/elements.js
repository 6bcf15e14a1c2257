// Small helpers to build the page with.

const find = (id) => document.getElementById(id);

/** Makes an element: attributes (functions are listeners, true is a bare attribute), then children, which are elements or text. */
function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") made.addEventListener(name, value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** A number as short text; what is not known is a dash. */
function short(value, digits = 4) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(digits - 2) : String(Number(value.toPrecision(digits)));
}

function table(head, rows) {
  const cells = (row, tag) => row.map((cell) => element(tag, { class: typeof cell === "number" || cell?.number ? "number" : null }, content(cell)));
  const content = (cell) => (typeof cell === "number" || cell === null || cell === undefined ? short(cell) : cell.number !== undefined ? cell.number : cell);
  return element(
    "table", {},
    element("thead", {}, element("tr", {}, ...cells(head, "th"))),
    element("tbody", {}, ...rows.map((row) => (row instanceof Element ? row : element("tr", {}, ...cells(row, "td"))))),
  );
}
