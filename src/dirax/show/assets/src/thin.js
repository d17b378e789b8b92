// Which points are drawn: in every pixel's worth of points the smallest and the largest of each line, and the ends.

export function kept(columns, first, last, buckets) {
  const count = last - first + 1;
  if (count <= 2 * buckets) return Array.from({ length: count }, (_, i) => first + i);
  const found = new Set([first, last]);
  for (let b = 0; b < buckets; b++) {
    const low = first + Math.floor((b * count) / buckets);
    const high = first + Math.floor(((b + 1) * count) / buckets);
    for (const values of columns) {
      let least = -1;
      let most = -1;
      for (let i = low; i < high; i++) {
        if (Number.isNaN(values[i])) continue;
        if (least < 0 || values[i] < values[least]) least = i;
        if (most < 0 || values[i] > values[most]) most = i;
      }
      if (least >= 0) found.add(least).add(most);
    }
  }
  return [...found].sort((a, b) => a - b);
}
