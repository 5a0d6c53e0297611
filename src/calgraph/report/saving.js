"use strict";

// Every figure can be saved as SVG or PNG.
const download = (url, name) => {
  const link = document.createElement("a");
  [link.href, link.download] = [url, name];
  link.click();
};
const fileName = (label) => label.toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "") || "figure";

// A self-contained SVG: with the rules of the page's style sheet, their colours written out, and a background.
const standalone = (svg, wrapper, picture) => {
  const style = getComputedStyle(document.documentElement);
  const css = document.querySelector("style").textContent
    .replace(/@media[^{]*\{(?:[^{}]*\{[^}]*\})*[^}]*\}/g, "")
    .replace(/var\((--[a-z-]+)\)/g, (_, name) => style.getPropertyValue(name).trim());
  const { x, y, width, height } = svg.viewBox.baseVal;
  const image = picture ? `<image href="${picture}" x="${x}" y="${y}" width="${width}" height="${height}"/>` : "";
  const paper = style.getPropertyValue("--paper").trim();
  const text =
    `<svg xmlns="http://www.w3.org/2000/svg" viewBox="${x} ${y} ${width} ${height}" width="${width}" height="${height}">` +
    `<style>text { font-family: sans-serif; } ${css.replace(/</g, "&lt;")} path { vector-effect: none !important; }</style>` +
    `<rect x="${x}" y="${y}" width="${width}" height="${height}" style="fill:${paper}"/>${image}` +
    `<g class="${wrapper}">${new XMLSerializer().serializeToString(svg).replace(/^<svg[^>]*>|<\/svg>$/g, "")}</g></svg>`;
  return { text, width, height };
};
const saveSvg = async ({ text, width, height }, format, name) => {
  const url = URL.createObjectURL(new Blob([text], { type: "image/svg+xml" }));
  if (format === "svg") return download(url, name);
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
  await image.decode();
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [2 * width, 2 * height];
  canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
  download(canvas.toDataURL("image/png"), name);
};

const addSaving = (after, label, save) => {
  const line = document.createElement("div");
  line.className = "save";
  for (const format of ["svg", "png"]) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = format.toUpperCase();
    button.title = `Save ${label} as ${format.toUpperCase()}`;
    button.addEventListener("click", () => save(format, `${fileName(label)}.${format}`));
    line.append(button);
  }
  after.insertAdjacentElement("afterend", line);
};
for (const place of document.querySelectorAll(".figure")) {
  addSaving(place, place.getAttribute("aria-label"), (format, name) => {
    const size = { width: place.clientWidth, height: place.clientHeight, scale: format === "png" ? 2 : 1 };
    Plotly.downloadImage(place, { ...size, format, filename: name.slice(0, -4) });
  });
}
for (const svg of document.querySelectorAll(".graph, .cover svg, .shot > div > svg[aria-hidden]")) {
  const shot = svg.closest(".shot");
  const box = shot ? shot.querySelector("div") : svg.closest(".scroller") ?? svg;
  const label = (shot ? box : svg).getAttribute("aria-label");
  const wrapper = shot ? "shot" : svg.closest(".cover") ? "cover" : svg.getAttribute("class");
  addSaving(box, label, (format, name) => saveSvg(standalone(svg, wrapper, shot?.querySelector("img")?.src), format, name));
}
