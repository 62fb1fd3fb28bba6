// The map: the reference's roads, and what an answer looks like on them.
import * as maplibre from "./maplibre-gl.mjs";

const EARTH_M = 6371000, RAD = Math.PI / 180;
const HERE = new URL(".", document.baseURI).href;  // the page may lie below a path
const EMPTY = { type: "FeatureCollection", features: [] };
const feature = (type, coordinates, properties = {}) => ({ type: "Feature", properties, geometry: { type, coordinates } });
const collection = (features) => ({ type: "FeatureCollection", features });

let map, shown = null;
const popup = new maplibre.Popup({ closeButton: false });
const markers = [];

/** Metres east and north from one place to another, [longitude, latitude] each. */
export function metres(from, to) {
  return [(to[0] - from[0]) * RAD * EARTH_M * Math.cos(from[1] * RAD), (to[1] - from[1]) * RAD * EARTH_M];
}

/** The place so many metres east and north of another. */
export function offset(from, [east, north]) {
  return [from[0] + east / (RAD * EARTH_M * Math.cos(from[1] * RAD)), from[1] + north / (RAD * EARTH_M)];
}

/** Make the map of what the server searches, opened on the first; false where the browser cannot draw it. */
export function makeMap({ references, basemap, basemap_attribution, max_zoom }) {
  const sources = {}, roads = [], names = [];
  if (basemap) {
    sources.basemap = { type: "raster", tiles: [basemap], tileSize: 256, attribution: plain(basemap_attribution) };
    roads.push({ id: "basemap", type: "raster", source: "basemap" });
  }
  references.forEach(({ bounds, attribution }, i) => {
    const tiles = [`${HERE}tiles/${i}/{z}/{x}/{y}.mvt`];
    sources[`roads-${i}`] = { type: "vector", tiles, maxzoom: max_zoom, bounds, attribution: plain(attribution) };
    const width = (a, b, c) => ["interpolate", ["exponential", 1.5], ["zoom"], 8, a, 13, b, 18, c];
    const line = { type: "line", source: `roads-${i}`, "source-layer": "roads", layout: { "line-cap": "round", "line-join": "round" } };
    roads.push({ ...line, id: `case-${i}`, minzoom: 12, paint: { "line-color": "#ffffff", "line-width": width(1, 3.4, 22) } });
    names.push({
      id: `names-${i}`, type: "symbol", source: `roads-${i}`, "source-layer": "streets", minzoom: 15.5,
      layout: { "symbol-placement": "line", "text-field": ["get", "name"], "text-size": 12, "text-font": ["sans-serif"] },
      paint: { "text-color": "#20262e", "text-halo-color": "#ffffff", "text-halo-width": 1.6 },
    });
    roads.push({ ...line, id: `road-${i}`, paint: { "line-color": "#8c949e", "line-width": width(0.5, 1.4, 14) } });
  });
  const data = { type: "geojson", data: EMPTY };
  Object.assign(sources, { area: data, outline: data, roads: data, matches: data, ends: data });
  const hidden = { visibility: "none" };
  try {
    map = new maplibre.Map({
      container: "map", bounds: references[0].bounds, fitBoundsOptions: { padding: padding() },
      attributionControl: false, fadeDuration: 0, maxPitch: 0, dragRotate: false, maxZoom: 21,
      style: {
        version: 8, sources, layers: [
          { id: "ground", type: "background", paint: { "background-color": "#f3f1ec" } }, ...roads,
          { id: "area", type: "fill", source: "area", paint: { "fill-color": "#1a5fa5", "fill-opacity": 0.12 } },
          { id: "area-edge", type: "line", source: "area", paint: { "line-color": "#1a5fa5", "line-width": 2, "line-dasharray": [2, 1] } },
          { id: "outline-case", type: "line", source: "outline", paint: { "line-color": "#ffffff", "line-width": 6 } },
          { id: "outline", type: "line", source: "outline", paint: { "line-color": ["case", ["boolean", ["get", "chosen"], false], "#e4572e", "#1a5fa5"], "line-width": 3 } },
          { id: "seen-case", type: "line", source: "roads", paint: { "line-color": "#ffffff", "line-width": 5, "line-opacity": 0.75 } },
          { id: "seen", type: "line", source: "roads", paint: { "line-color": "#e4572e", "line-width": 2.4 } },
          { id: "matches", type: "line", source: "matches", layout: hidden, paint: { "line-color": "#6a1b9a", "line-width": 3 } },
          { id: "ends", type: "circle", source: "ends", layout: hidden,
            paint: { "circle-radius": 4.5, "circle-color": "#1b263b", "circle-stroke-color": "#ffffff", "circle-stroke-width": 1.5 } },
          ...names,
        ],
      },
    });
  } catch (error) {
    console.warn(error.message);
    return false;
  }
  map.touchZoomRotate.disableRotation();
  map.keyboard.disableRotation();
  map.addControl(new maplibre.NavigationControl({ showCompass: false }), "top-right");
  map.addControl(new maplibre.ScaleControl(), "bottom-right");
  map.addControl(new maplibre.AttributionControl({ compact: false }), "bottom-right");
  map.on("click", ({ point, lngLat }) => {
    const reach = [[point.x - 6, point.y - 6], [point.x + 6, point.y + 6]];
    const [hit] = map.isStyleLoaded() ? map.queryRenderedFeatures(reach, { layers: ["ends"] }) : [];
    if (hit) popup.setLngLat(lngLat).setText(`Residual ${hit.properties.residual.toFixed(1)} m`).addTo(map);
  });
  map.getCanvas().setAttribute("aria-label", "Map: arrow keys move it, plus and minus enlarge and reduce it");
  return true;
}

/** Room that the panel takes, so that what matters lies beside it. */
function padding() {
  const beside = innerWidth > 760;
  return { top: 50, bottom: 50, right: 50, left: beside ? document.getElementById("panel").offsetWidth + 60 : 50 };
}

/** The words of a licence, which may be written in HTML, as HTML that is nothing but text. */
function plain(text) {
  const words = new DOMParser().parseFromString(text || "", "text/html").body.textContent;
  return new Option(words).innerHTML;
}

const ready = () => new Promise((done) => (map.loaded() || map.isStyleLoaded() ? done() : map.once("load", done)));

/** Show an answer: its view as the server tells it, and its document; nothing for null. */
export async function showAnswer(base, view, found) {
  if (!map) return;
  shown = base;
  await ready();
  if (shown !== base) return;
  clearMarkers();
  if (map.getLayer("photo")) map.removeLayer("photo");
  if (map.getSource("photo")) map.removeSource("photo");
  refused = [];
  const place = view?.place, matches = place?.matches ?? [];
  set("outline", place ? [feature("LineString", place.outline)] : []);
  set("roads", place ? [feature("MultiLineString", place.roads)] : []);
  set("matches", matches.map((match) => feature("LineString", [match.map, match.seen])));
  set("ends", matches.map((match) => feature("Point", match.map, { residual: match.residual_m })));
  if (!place) {
    showRefused(found);
    return;
  }
  if (place.warped) {
    map.addSource("photo", { type: "image", url: `${HERE}${base}/warped.webp`, coordinates: place.warped });
    map.addLayer({ id: "photo", type: "raster", source: "photo", paint: { "raster-opacity": 1, "raster-fade-duration": 0 } }, "outline-case");
  }
  setOpacity(opacity);
  const others = found.status === "ambiguous" ? onMap(found.alternatives, found.reference) : [];
  fit(boxOf([...place.outline, ...others.map(({ center }) => [center.lon, center.lat])]));
}

export const boxOf = (corners) => corners.reduce((all, corner) => all.extend(corner), new maplibre.LngLatBounds());
const onMap = (places, reference) => (places ?? []).filter((one) => one.reference === reference);

let refused = [];
const outline = (chosen) => set("outline", refused.map((place) => feature("LineString", [...place.footprint_lonlat, place.footprint_lonlat[0]], { chosen: place === chosen })));

/** Look at one of the places of an answer. */
export function lookAt(place) {
  if (refused.includes(place)) outline(place);
  fit(boxOf(place.footprint_lonlat ?? [[place.center.lon, place.center.lat]]));
}

/** Outline the best places of a refusal, and look at those on the map of the first. */
function showRefused(found) {
  const places = (found?.alternatives ?? []).filter((one) => one.footprint_lonlat);
  if (!places.length) return;
  refused = places;
  outline();
  fit(boxOf(onMap(places, places[0].reference).flatMap((one) => one.footprint_lonlat)));
}

function set(source, features) {
  map.getSource(source).setData(collection(features));
}

/** Show all of a box, such as the bounds of a reference; at once where nothing of it is in view. */
export function fit(box) {
  const there = maplibre.LngLatBounds.convert(box), here = map.getBounds();
  const apart = there.getWest() > here.getEast() || there.getEast() < here.getWest() || there.getSouth() > here.getNorth() || there.getNorth() < here.getSouth();
  const still = apart || matchMedia("(prefers-reduced-motion: reduce)").matches;
  map.fitBounds(there, { padding: padding(), maxZoom: 18, duration: still ? 0 : 700 });
}

let opacity = 0.85;
/** Fade the photograph, not the roads above it. */
export function setOpacity(value) {
  opacity = value;
  if (map?.getLayer("photo")) map.setPaintProperty("photo", "raster-opacity", value);
}

export function showLayers(names, visible) {
  if (!map) return;
  ready().then(() => names.forEach((name) => map.setLayoutProperty(name, "visibility", visible ? "visible" : "none")));
}

/** Put a button on the map. */
export function addMarker(lonlat, text, label, kind, options = {}) {
  const pin = document.createElement("button");
  pin.type = "button";
  pin.className = `pin ${kind}`;
  pin.textContent = text;
  pin.setAttribute("aria-label", label);
  const marker = new maplibre.Marker({ element: pin, ...options }).setLngLat(lonlat).addTo(map);
  markers.push(marker);
  return marker;
}

export function clearMarkers() {
  popup.remove();
  markers.splice(0).forEach((marker) => marker.remove());
}

export function middle() {
  const { lng, lat } = map.getCenter();
  return [lng, lat];
}

/** Show where it is said to lie: near [lon, lat, metres]; null for nowhere. */
export function showArea(near) {
  if (!map) return;
  const ring = near && Array.from({ length: 65 }, (_, i) => offset(near, [near[2] * Math.cos(i * Math.PI / 32), near[2] * Math.sin(i * Math.PI / 32)]));
  ready().then(() => set("area", ring ? [feature("Polygon", [ring])] : []));
}

let stop = null;
/** Have a circle drawn, from its middle outwards: `done` gets it; drawing anew or `stopDrawing` ends it. */
export function drawCircle(done) {
  stopDrawing();
  const box = map.getContainer(), canvas = map.getCanvasContainer();
  box.classList.add("draws");
  map.dragPan.disable();
  map.boxZoom.disable();
  let from = null, start = null;
  const at = ({ clientX, clientY }) => {
    const edge = box.getBoundingClientRect(), { lng, lat } = map.unproject([clientX - edge.left, clientY - edge.top]);
    return [lng, lat];
  };
  const circle = (event) => [...from, Math.max(Math.hypot(...metres(from, at(event))), 1)];
  const down = (event) => {
    if (event.button) return;
    event.preventDefault();
    canvas.setPointerCapture(event.pointerId);
    [from, start] = [at(event), event];
  };
  const move = (event) => from && showArea(circle(event));
  const up = (event) => {
    if (!from) return;
    const { clientX, clientY } = start, isClick = Math.hypot(event.clientX - clientX, event.clientY - clientY) < 6;
    const near = circle(isClick ? { clientX: clientX + innerWidth / 10, clientY } : event);  // a click: a fifth of what is seen
    stopDrawing();
    showArea(near);
    done(near);
  };
  canvas.style.touchAction = "none";
  const heard = { pointerdown: down, pointermove: move, pointerup: up };
  Object.entries(heard).forEach(([name, what]) => canvas.addEventListener(name, what, true));
  stop = () => {
    Object.entries(heard).forEach(([name, what]) => canvas.removeEventListener(name, what, true));
    canvas.style.touchAction = "";
    box.classList.remove("draws");
    map.dragPan.enable();
    map.boxZoom.enable();
  };
}

export function stopDrawing() {
  stop?.();
  stop = null;
}

let clicked = null;
/** Hear of the next click on the map; null: of none. */
export function onClick(what) {
  if (clicked) map.off("click", clicked);
  clicked = what && ((event) => what([event.lngLat.lng, event.lngLat.lat]));
  if (clicked) map.on("click", clicked);
  map.getContainer().classList.toggle("draws", Boolean(what));
}

export const theMap = () => map;
