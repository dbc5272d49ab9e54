// Half the height of a view at distance 1 in a window of some aspect: rows of fov are rising aspects, each with the
// vertical field of view in degrees. Halves between two rows are interpolated as a power of the aspect.
function halfHeight(fov, aspect) {
  const half = ([, degrees]) => Math.tan(degrees * Math.PI / 360);
  const after = fov.findIndex(([wide]) => wide >= aspect);
  if (after < 1) return half(fov.at(after));
  const [narrower, wider] = fov.slice(after - 1, after + 1);
  const share = Math.log(aspect / narrower[0]) / Math.log(wider[0] / narrower[0]);
  return half(narrower) ** (1 - share) * half(wider) ** share;
}
