//! A page containing the vector graphics, with a cursor that reads the curves' values, and a legend whose
//! entries hide and show them. It is self-contained.

use std::fmt::Write as _;

use super::model::{Plot, colour_of};
use super::scene::Scene;
use super::svg;

/// Makes the page.
pub(super) fn write(plot: &Plot, scene: &Scene) -> String {
    let title = svg::escaped(if plot.title.is_empty() { "cantap plot" } else { &plot.title });
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<title>{title}</title>\n\
         <style>{STYLE}</style>\n</head>\n<body>\n{}<div id=\"values\"></div>\n\
         <script>\nconst plot = {};\n{SCRIPT}</script>\n</body>\n</html>\n",
        svg::write(scene),
        data(plot, scene)
    )
}

/// Everything that the script needs, as a JavaScript object.
fn data(plot: &Plot, scene: &Scene) -> String {
    let mut out = String::from("{");
    // Writing to a String cannot fail.
    let _ = write!(out, "\"span\":[{},{}],\"panes\":[", scene.span.0, scene.span.1);
    for (index, area) in scene.panes.iter().enumerate() {
        let comma = if index == 0 { "" } else { "," };
        let _ = write!(out, "{comma}[{},{},{},{}]", area.left, area.top, area.right, area.bottom);
    }
    out.push_str("],\"curves\":[");
    let curves =
        plot.panes.iter().flat_map(|pane| pane.content.curves().iter().map(move |curve| (pane, curve)));
    for (index, (pane, curve)) in curves.enumerate() {
        let comma = if index == 0 { "" } else { "," };
        let [red, green, blue] = colour_of(curve, index);
        let _ = write!(
            out,
            "{comma}{{\"name\":{},\"unit\":{},\"colour\":\"#{red:02x}{green:02x}{blue:02x}\",\"stepped\":{},\"texts\":[",
            quoted(&curve.name),
            quoted(&pane.label),
            curve.stepped
        );
        for (index, (value, text)) in curve.texts.iter().enumerate() {
            let comma = if index == 0 { "" } else { "," };
            let _ = write!(out, "{comma}[{value},{}]", quoted(text));
        }
        out.push_str("],\"points\":[");
        for (index, point) in curve.series.points().iter().enumerate() {
            let comma = if index == 0 { "" } else { "," };
            if point.y.is_nan() {
                let _ = write!(out, "{comma}[{},null]", point.x);
            } else {
                let _ = write!(out, "{comma}[{},{}]", point.x, point.y);
            }
        }
        out.push_str("]}");
    }
    out.push_str("]}");
    out
}

/// A string for a script in a page: nothing in it can end the string or the script.
fn quoted(text: &str) -> String {
    let mut out = String::from("\"");
    for character in text.chars() {
        match character {
            '"' | '\\' | '<' | '>' | '&' | '\u{2028}' | '\u{2029}' => {
                let _ = write!(out, "\\u{:04x}", character as u32);
            }
            character if cantap_trace::clean::is_harmful(character) => {}
            character => out.push(character),
        }
    }
    out.push('"');
    out
}

const STYLE: &str = "body{margin:16px;font:14px 'DejaVu Sans',Verdana,sans-serif;color:#222}\
svg{max-width:100%;height:auto;cursor:crosshair}\
text[data-curve]{cursor:pointer}\
#values{min-height:1.5em;margin:4px 0 0 84px}\
#values span{margin-right:24px;white-space:nowrap}";

const SCRIPT: &str = r##"const svg = document.querySelector("svg");
const values = document.getElementById("values");
const cursor = document.createElementNS("http://www.w3.org/2000/svg", "line");
cursor.setAttribute("stroke", "#222");
cursor.setAttribute("stroke-dasharray", "3 3");
cursor.setAttribute("pointer-events", "none");
const hidden = new Set();

// The curve's value at x; null if it is interrupted or undefined there.
function valueAt(curve, x) {
  const points = curve.points;
  let low = 0, high = points.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (points[middle][0] <= x) low = middle + 1; else high = middle;
  }
  const before = points[low - 1], after = points[low];
  if (!before || before[1] === null) return null;
  if (curve.stepped) return before[1];
  if (!after) return before[0] === x ? before[1] : null;
  if (after[1] === null) return null;
  const width = after[0] - before[0];
  return width > 0 ? before[1] + (after[1] - before[1]) * (x - before[0]) / width : before[1];
}

svg.addEventListener("mousemove", (event) => {
  if (!plot.panes.length) return;
  const place = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  const [left, top, right] = plot.panes[0];
  const bottom = plot.panes[plot.panes.length - 1][3];
  if (place.x < left || place.x > right) { cursor.remove(); values.textContent = ""; return; }
  for (const [name, value] of [["x1", place.x], ["x2", place.x], ["y1", top], ["y2", bottom]])
    cursor.setAttribute(name, value);
  svg.append(cursor);
  const x = plot.span[0] + (place.x - left) / (right - left) * (plot.span[1] - plot.span[0]);
  values.textContent = "";
  const add = (text, colour) => {
    const span = document.createElement("span");
    span.textContent = text;
    span.style.color = colour;
    values.append(span);
  };
  add(x.toPrecision(9).replace(/\.?0+$/, ""), "#666");
  plot.curves.forEach((curve, index) => {
    if (hidden.has(index)) return;
    const value = valueAt(curve, x);
    const text = curve.texts.find((entry) => entry[0] === value);
    const shown = value === null ? "–" : +value.toPrecision(6) + (text ? ` (${text[1]})` : "");
    add(`${curve.name} ${shown} ${curve.unit}`, curve.colour);
  });
});
svg.addEventListener("mouseleave", () => { cursor.remove(); values.textContent = ""; });

for (const entry of svg.querySelectorAll("text[data-curve]")) {
  entry.addEventListener("click", () => {
    const index = Number(entry.dataset.curve);
    const hide = !hidden.has(index);
    if (hide) hidden.add(index); else hidden.delete(index);
    for (const part of svg.querySelectorAll(`[data-curve="${index}"]`)) {
      if (part === entry) part.style.opacity = hide ? 0.4 : 1;
      else part.style.display = hide ? "none" : "";
    }
  });
}
"##;
