"""The style sheet of the report: light and dark, from a phone to a wide screen, and on paper."""

CSS = """
:root { color-scheme: light dark; --paper: #fcfcfb; --card: #ffffff; --ink: #1c1d20; --soft: #5c606a; --line: #dfe0e3;
  --search: #1d5fd0; --baseline: #b4540a; --clean: #1f7a45; --track: #e6e7ea; --warn: #8a5300; --warn-paper: #fdf4e3; }
@media screen and (prefers-color-scheme: dark) { :root { --paper: #15171b; --card: #1d2025; --ink: #e8e9ec;
  --soft: #a3a8b3; --line: #363a42; --search: #7aaaf8; --baseline: #f0a35e; --clean: #6cc792; --track: #353942;
  --warn: #f2c879; --warn-paper: #2e2718; } }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--paper); color: var(--ink); 
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
header, main, footer { max-width: 62rem; margin: 0 auto; padding: 0 1.25rem; }
header { padding-top: 2.5rem; }
h1 { font-size: clamp(1.4rem, 1.05rem + 1.7vw, 2.1rem); line-height: 1.25; font-weight: 650; letter-spacing: -0.012em;
  margin: 0.3rem 0 0.9rem; max-width: 46rem; text-wrap: balance; }
h2 { font-size: 1.15rem; margin: 2.6rem 0 0.8rem; font-weight: 650; }
p { margin: 0.5rem 0; max-width: 46rem; }
.eyebrow, .soft, figcaption, .note { color: var(--soft); }
.eyebrow { font-size: 0.9rem; margin: 0; }
.remarks { list-style: none; margin: 1rem 0 0; padding: 0.6rem 0.9rem; border-left: 3px solid var(--warn);
  background: var(--warn-paper); max-width: 46rem; }
.remarks li + li, .notes li + li { margin-top: 0.35rem; }
.notes { list-style: none; margin: 0.8rem 0 0; padding: 0; max-width: 46rem; color: var(--soft); font-size: 0.92rem; }
header .remarks li, header .notes li, .eyebrow { overflow-wrap: anywhere; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(14rem, 44%), 1fr)); gap: 1.25rem 1rem; }
.pictures.pair { max-width: 40rem; }
.pictures.rows { grid-template-columns: 1fr; }
.pictures.single { max-width: 24rem; }
.pictures.large { grid-template-columns: repeat(auto-fit, minmax(min(22rem, 100%), 1fr)); }
.pictures.small { grid-template-columns: repeat(auto-fill, minmax(7rem, 1fr)); gap: 0.6rem; }
figure { margin: 0; }
figure img { display: block; width: 100%; height: auto; border-radius: 4px; background: var(--track); }
figcaption { font-size: 0.92rem; margin-top: 0.45rem; overflow-wrap: anywhere; }
figcaption strong { color: var(--ink); font-weight: 600; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 0.5rem 1rem 0.5rem 0; border-bottom: 1px solid var(--line);
  vertical-align: middle; }
thead th { font-size: 0.85rem; font-weight: 500; color: var(--soft); white-space: nowrap; }
tbody th { font-weight: 500; }
td.number { white-space: nowrap; }
.facts { max-width: 46rem; }
.facts th { color: var(--soft); font-weight: 400; width: 11rem; vertical-align: top; }
.facts td { overflow-wrap: anywhere; }
.interval { position: relative; height: 12px; min-width: 7rem; max-width: 16rem;
  background: linear-gradient(var(--track), var(--track)) 0 50% / 100% 2px no-repeat; }
.interval span { position: absolute; } .interval .range { top: 3px; height: 6px; min-width: 1px; border-radius: 1px;
  background: var(--soft); opacity: 0.55; }
.interval .mark { top: 0; height: 12px; width: 2px; margin-left: -1px; background: var(--ink); }
svg.chart { display: block; width: 100%; height: auto; } svg.narrow { display: none; }
svg.chart text { font-family: inherit !important; }
details { margin-top: 1.2rem; }
summary { cursor: pointer; font-weight: 500; }
details > :not(summary) { margin-top: 0.8rem; }
pre { background: var(--card); border: 1px solid var(--line); border-radius: 4px; padding: 0.75rem 0.9rem;
  overflow-x: auto;
  font: 0.86rem/1.5 ui-monospace, SFMono-Regular, Menlo, Consolas, "DejaVu Sans Mono", monospace; margin: 0.5rem 0; }
pre.wrap { white-space: pre-wrap; overflow-wrap: anywhere; }
footer { margin-top: 3rem; padding-top: 1rem; padding-bottom: 2.5rem; font-size: 0.88rem; color: var(--soft); }
.scroll.wide img { min-width: 27rem; }
@media (max-width: 34rem) { .facts th { width: 7.5rem; } .hide-small, svg.wide { display: none; }
  svg.narrow { display: block; } .scroll th, .scroll td { padding-right: 0.5rem; font-size: 0.88rem; }
  .scroll thead th { white-space: normal; } }
@media print { :root { color-scheme: light; } body { background: none; } .scroll { overflow: visible; }
  h2 { break-after: avoid; } figure, table { break-inside: avoid; } }
"""
