"""How a report looks: readable on a phone and on paper, light or dark as the reader's system has it."""

CSS = """
:root { color-scheme: light dark;
  --ink: #1c2126; --faint: #5b6670; --paper: #ffffff; --card: #f5f7f9; --line: #d7dde3; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e8ec; --faint: #9aa5b0; --paper: #14181c; --card: #1d2328; --line: #353e47; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 72rem; padding: 1rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0.5rem 0; }
h2 { font-size: 1.2rem; margin: 2rem 0 0.5rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 0.4rem; }
p { margin: 0.4rem 0; }
.faint, figcaption { color: var(--faint); font-size: 0.9rem; }
.scroll { overflow-x: auto; margin: 0.5rem 0; }
table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.3rem 0.7rem; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top;
  overflow-wrap: normal; }
tbody th { font-weight: normal; min-width: 8rem; max-width: 24rem; overflow-wrap: break-word; }
thead th { font-weight: 600; white-space: nowrap; }
td.number { text-align: right; white-space: nowrap; }
td small { display: block; color: var(--faint); font-size: 0.85em; }
.clear { font-weight: 600; }
.warning { color: #b3401a; }
@media (prefers-color-scheme: dark) { .warning { color: #ff9a6b; } }
.gallery { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(22rem, 100%), 1fr)); gap: 1rem; }
.films { grid-template-columns: repeat(auto-fill, minmax(min(16rem, 100%), 1fr)); }
figure { margin: 0; padding: 0.6rem; background: var(--card); border: 1px solid var(--line); border-radius: 0.4rem; }
figure img, figure video { display: block; width: 100%; height: auto; }
.legend { list-style: none; padding: 0; margin: 0.5rem 0; display: flex; flex-wrap: wrap; gap: 0.3rem 1.2rem;
  font-size: 0.9rem; }
svg.line { width: 2.2rem; height: 0.7rem; margin-right: 0.4rem; vertical-align: baseline; flex: none; }
details { margin: 0.5rem 0; border: 1px solid var(--line); border-radius: 0.4rem; padding: 0.4rem 0.8rem;
  background: var(--card); }
summary { cursor: pointer; }
pre { margin: 0.5rem 0; padding: 0.6rem; background: var(--card); border: 1px solid var(--line); border-radius: 0.4rem;
  font-size: 0.85rem; white-space: pre-wrap; overflow-wrap: anywhere; }
nav a { margin-right: 1rem; }
a { color: inherit; }
@media (max-width: 40rem) {
  th, td { padding: 0.3rem 0.4rem; }
  thead th { white-space: normal; }
  tbody th { min-width: 5rem; }
}
@media print {
  :root { --ink: #000; --faint: #444; --paper: #fff; --card: #fff; --line: #bbb; color-scheme: light; }
  body { max-width: none; font-size: 10pt; padding: 0; }
  nav { display: none; }
  .scroll { overflow: visible; }
  figure, tr { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
}
"""
