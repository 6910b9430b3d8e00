/** The rendering library, imported from one place. */

export {
  Component, Fragment, h, html, render, useCallback, useEffect, useId, useLayoutEffect, useMemo, useRef, useState,
} from "/console/static/vendor/preact.js";
