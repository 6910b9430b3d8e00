// The views' way to say what the page shows: elements as tagged templates, no string ever parsed as HTML.
import htm from "htm";
import { h } from "preact";

export { Component, Fragment, h, render } from "preact";
export { useCallback, useEffect, useId, useLayoutEffect, useMemo, useRef, useState } from "preact/hooks";
export const html = htm.bind(h);
