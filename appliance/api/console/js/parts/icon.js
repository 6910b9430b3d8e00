/** Icons in the colour of the text. */

import { html } from "../html.js";

const DRAWN = {
  now: "M3 12h4l2.500-6 4 12 2.500-6h5",
  graph: "M6 6m-2.500 0a2.500 2.500 0 1 0 5 0a2.500 2.500 0 1 0-5 0M18 8m-2.500 0a2.500 2.500 0 1 0 5 0a2.500 2.500 0 1 0-5 0M10 18m-2.500 0a2.500 2.500 0 1 0 5 0a2.500 2.500 0 1 0-5 0M8.500 6.500l7 1M7 8.300l2.200 7.300M16.500 10l-5 6",
  audit: "M6 3h9l4 4v14H6zM14.500 3v4.500H19M9 12h7M9 16h7",
  policy: "M12 3l7.500 2.800v5.700c0 4.500-3.100 7.800-7.500 9.500-4.400-1.700-7.500-5-7.500-9.500V5.800zM9 12l2.200 2.200L15.500 10",
  monitors: "M2.500 12S6 5.500 12 5.500 21.500 12 21.500 12 18 18.500 12 18.500 2.500 12 2.500 12zM12 12m-2.800 0a2.800 2.800 0 1 0 5.600 0a2.800 2.800 0 1 0-5.600 0",
  hosts: "M4 4.500h16v10H4zM9 19.500h6M12 14.500v5",
  recordings: "M12 12m-8.500 0a8.500 8.500 0 1 0 17 0a8.500 8.500 0 1 0-17 0M12 12m-3.200 0a3.200 3.200 0 1 0 6.400 0a3.200 3.200 0 1 0-6.400 0",
  robot: "M5 9h14v10H5zM12 9V5M12 5m-1.200 0a1.200 1.200 0 1 0 2.400 0a1.200 1.200 0 1 0-2.400 0M9.200 13v1.500M14.800 13v1.500M2.500 12.500v3M21.500 12.500v3",
  sun: "M12 12m-4 0a4 4 0 1 0 8 0a4 4 0 1 0-8 0M12 2.500v2M12 19.500v2M2.500 12h2M19.500 12h2M5.300 5.300l1.400 1.400M17.300 17.300l1.400 1.400M18.700 5.300l-1.400 1.400M6.700 17.300l-1.400 1.400",
  moon: "M20 14.500A8.500 8.500 0 0 1 9.500 4 8.500 8.500 0 1 0 20 14.500z",
  out: "M14 4h5.500v16H14M10 8l-4 4 4 4M6 12h9",
  close: "M6 6l12 12M18 6L6 18",
  check: "M5 12.500l4.500 4.500L19 7.500",
  warn: "M12 4l9 16H3zM12 10v4.500M12 17v.500",
  stop: "M12 12m-8.500 0a8.500 8.500 0 1 0 17 0a8.500 8.500 0 1 0-17 0M6.200 6.200l11.600 11.600",
  info: "M12 12m-8.500 0a8.500 8.500 0 1 0 17 0a8.500 8.500 0 1 0-17 0M12 11v5.500M12 7.500v.500",
  search: "M11 11m-6.500 0a6.500 6.500 0 1 0 13 0a6.500 6.500 0 1 0-13 0M16 16l4.500 4.500",
  down: "M12 4v11M7 11l5 5 5-5M5 20h14",
  up: "M12 20V9M7 13l5-5 5 5M5 4h14",
  back: "M14 6l-6 6 6 6",
  next: "M10 6l6 6-6 6",
  plus: "M12 5v14M5 12h14",
  minus: "M5 12h14",
  fit: "M4 9V4h5M15 4h5v5M20 15v5h-5M9 20H4v-5",
  again: "M19.500 12a7.500 7.500 0 1 1-2.200-5.300L20 9M20 4v5h-5",
  play: "M7 5l12 7-12 7z",
  pause: "M8 5v14M16 5v14",
  link: "M10 14a4 4 0 0 0 5.700 0l3-3a4 4 0 0 0-5.700-5.700l-1 1M14 10a4 4 0 0 0-5.700 0l-3 3a4 4 0 0 0 5.700 5.700l1-1",
  key: "M8 15m-4.500 0a4.500 4.500 0 1 0 9 0a4.500 4.500 0 1 0-9 0M11.500 11.500L20 3M16 7l3 3",
  keyboard: "M3 6.500h18v11H3zM6.500 10h.500M10.200 10h.500M13.900 10h.500M17.500 10h.500M7.500 14h9",
  copy: "M9 9h11v11H9zM5 15H4V4h11v1",
  filter: "M4 5h16l-6 7.500V19l-4-2v-4.500z",
};

/** @param {{name: keyof typeof DRAWN, size?: number}} given */
export function Icon({ name, size = 18 }) {
  return html`<svg width=${size} height=${size} viewBox="0 0 24 24" fill="none" stroke="currentColor" stroke-width="1.7"
    stroke-linecap="round" stroke-linejoin="round" aria-hidden="true"><path d=${DRAWN[name]} /></svg>`;
}

/** The product's logo. */
export function Mark({ size = 30 }) {
  return html`<svg width=${size} height=${size} viewBox="0 0 32 32" aria-hidden="true">
    <rect width="32" height="32" rx="7" fill="#1d4f91" />
    <path d="M16 5.500l8.500 3.400v6.300c0 5.400-3.500 9.400-8.500 11.300-5-1.900-8.500-5.900-8.500-11.300V8.900z" fill="none" stroke="#fff" stroke-width="2" stroke-linejoin="round" />
    <circle cx="16" cy="15.500" r="2.600" fill="#fff" /><path d="M9.500 15.500h3.500M19 15.500h3.500" stroke="#fff" stroke-width="2" />
  </svg>`;
}
