// Points in the picture and the same on the map: where the picture then lies, how large its pixels are, where up is.
import { metres, offset } from "./map.mjs";

/**
 * The similarity that leads pixels (column, row) to places, fitted to pairs of both by least squares.
 * Returns the middle [lon, lat], metres per pixel, where up points (degrees clockwise from north), and the root mean
 * square misfit in metres; null where the points coincide.
 */
export function fitPoints(pairs, [width, height]) {
  if (pairs.length < 2) return null;
  const home = pairs[0].lonlat, n = pairs.length;
  const from = pairs.map(({ pixel: [column, row] }) => [column, -row]);  // y up, as on the map
  const to = pairs.map(({ lonlat }) => metres(home, lonlat));
  const mean = (points) => [0, 1].map((k) => points.reduce((sum, one) => sum + one[k], 0) / n);
  const [a, b] = [mean(from), mean(to)];
  let across = 0, turned = 0, spread = 0;
  from.forEach(([x, y], i) => {
    const [dx, dy, u, v] = [x - a[0], y - a[1], to[i][0] - b[0], to[i][1] - b[1]];
    across += dx * u + dy * v;
    turned += dx * v - dy * u;
    spread += dx * dx + dy * dy;
  });
  if (!(spread > 0)) return null;
  const [c, s] = [across / spread, turned / spread];
  const lay = ([x, y]) => [b[0] + c * (x - a[0]) - s * (y - a[1]), b[1] + s * (x - a[0]) + c * (y - a[1])];
  const off = Math.sqrt(from.reduce((sum, one, i) => sum + Math.hypot(lay(one)[0] - to[i][0], lay(one)[1] - to[i][1]) ** 2, 0) / n);
  const gsd = Math.hypot(c, s);
  return gsd > 0 ? { middle: offset(home, lay([width / 2, -height / 2])), gsd, heading: Math.atan2(-s, c) * 180 / Math.PI, off } : null;
}

const digits = (value, n) => Number(value.toFixed(n)), three = (value) => Number(value.toPrecision(3));

/** Points as the server takes them: column, row, longitude and latitude of each. */
export const written = (pairs) => pairs.map(({ pixel, lonlat }) => [...pixel.map((one) => digits(one, 1)), ...lonlat.map((one) => digits(one, 6))]).join(",");

/** The hints that points give, rounded; two are taken less exactly, for a tilted picture is no similarity. */
export function hintsOf(pairs, size) {
  const fit = fitPoints(pairs, size);
  if (!fit) return null;
  const diagonal = fit.gsd * Math.hypot(...size), [loose, turn] = pairs.length > 2 ? [1.25, 10] : [1.35, 15];
  return {
    near: [...fit.middle.map((one) => digits(one, 6)), Math.ceil(Math.max(0.25 * diagonal, 4 * fit.off))],
    gsd: [three(fit.gsd / loose), three(fit.gsd * loose)],
    heading: [digits(fit.heading, 1), turn],
  };
}
