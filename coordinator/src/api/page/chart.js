// The chart: efficiency over time, drawn as SVG. It is given samples and draws them; it
// asks for nothing.

const SVG = "http://www.w3.org/2000/svg";
const HOUR_MS = 3_600_000;
const MARGIN = { left: 44, right: 8, top: 6, bottom: 18 };

function shape(name, attributes, text) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

/// Draws samples `{at_ms, efficiency, frames_per_s, workers}`, oldest first.
export function draw(svg, samples) {
  const width = svg.clientWidth || 600;
  const height = svg.clientHeight || 140;
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.replaceChildren();
  const bottom = height - MARGIN.bottom;
  const end = samples.length ? samples[samples.length - 1].at_ms : 0;
  // A farm that has just started is not squeezed into the last pixels of an hour.
  const age = samples.length ? end - samples[0].at_ms : 0;
  const span = Math.min(HOUR_MS, Math.max(5 * 60_000, age));
  const x = (at) => width - MARGIN.right - ((end - at) / span) * (width - MARGIN.left - MARGIN.right);
  const y = (share) => bottom - share * (bottom - MARGIN.top);
  for (const share of [0, 0.5, 1]) {
    svg.append(shape("line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: y(share), y2: y(share) }));
    svg.append(shape("text", { x: MARGIN.left - 6, y: y(share) + 4, "text-anchor": "end" }, `${share * 100} %`));
  }
  const minutes = Math.round(span / 60_000);
  for (const part of [0, 0.5, 1]) {
    const anchor = part === 0 ? "end" : part === 1 ? "start" : "middle";
    const text = part === 0 ? "now" : `${Math.round(minutes * part * 10) / 10} min ago`;
    svg.append(shape("text", { x: x(end - part * span), y: height - 3, "text-anchor": anchor }, text));
  }
  const shown = samples.filter((sample) => sample.at_ms >= end - span);
  if (shown.length === 0) {
    svg.append(shape("text", { x: width / 2, y: y(0.5) - 6, "text-anchor": "middle" }, "the first sample comes after 5 seconds"));
    return;
  }
  const points = shown.map((sample) => `${x(sample.at_ms).toFixed(1)},${y(sample.efficiency).toFixed(1)}`);
  const first = x(shown[0].at_ms).toFixed(1);
  svg.append(shape("path", { class: "area", d: `M${first},${bottom} L${points.join(" L")} L${x(end).toFixed(1)},${bottom} Z` }));
  svg.append(shape("path", { class: "curve", d: `M${points.join(" L")}` }));
  const last = shown[shown.length - 1];
  svg.setAttribute("aria-label", `Efficiency over the last ${minutes} minutes; now ${Math.round(100 * last.efficiency)} percent`);
}
