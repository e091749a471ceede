"use strict";
(() => {
  const copy = async (text) => {
    if (navigator.clipboard && window.isSecureContext) return navigator.clipboard.writeText(text);
    const field = document.createElement("textarea");
    field.value = text;
    document.body.append(field);
    field.select();
    document.execCommand("copy");
    field.remove();
  };
  const number = (text) => parseFloat(text.replace(/^[<≤\s]+/, "").replace("−", "-"));
  const before = (a, b) => {
    const [x, y] = [number(a), number(b)];
    if (!Number.isNaN(x) && !Number.isNaN(y)) return x - y;
    return Number.isNaN(x) - Number.isNaN(y) || a.localeCompare(b);  // numbers first
  };
  for (const table of document.querySelectorAll("table")) {
    const [heads, body] = [[...table.tHead.rows[0].cells], table.tBodies[0]];
    heads.forEach((head, k) => {
      const button = document.createElement("button");
      button.append(...head.childNodes);
      button.title = "sort";
      head.append(button);
      button.addEventListener("click", () => {
        const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
        heads.forEach((one) => one.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
        body.append(...[...body.rows].sort((a, b) => sign * before(a.cells[k].textContent, b.cells[k].textContent)));
      });
    });
    const button = document.createElement("button");
    button.className = "copy";
    button.textContent = "Copy as CSV";
    button.addEventListener("click", async () => {
      const quoted = (cell) => `"${cell.textContent.replaceAll('"', '""')}"`;
      await copy([...table.rows].map((row) => [...row.cells].map(quoted).join(",")).join("\r\n") + "\r\n");
      button.textContent = "Copied";
    });
    table.caption.append(" ", button);
  }
  document.documentElement.classList.add("live");
  if (window.Bokeh) Bokeh.set_log_level("warn");
  const draw = (place) => {
    if (place.dataset.drawn) return;
    place.dataset.drawn = "yes";
    Bokeh.embed.embed_item(JSON.parse(place.nextElementSibling.textContent), place);
  };
  for (const place of document.querySelectorAll(".chart")) {
    const folded = place.closest("details");
    if (folded && !folded.open) folded.addEventListener("toggle", () => draw(place));
    else draw(place);
  }
  const folded = document.querySelectorAll("details");
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...folded].filter((one) => !one.open);
    opened.forEach((one) => { one.open = true; });
  });
  addEventListener("afterprint", () => opened.forEach((one) => { one.open = false; }));
})();
