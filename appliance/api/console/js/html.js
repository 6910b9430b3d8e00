/** The one place where the views take their rendering from. */

export {
  Component, Fragment, h, html, render, useCallback, useEffect, useId, useLayoutEffect, useMemo, useRef, useState,
} from "/console/static/vendor/preact.js";
