// What both pages share: the picture's size is in the address, the picture or what went wrong goes back to the test.
const query = new URLSearchParams(location.search);
export const size = [Number(query.get("width")), Number(query.get("height"))];

// Splats are sorted by a worker, some frames behind: the picture is done when it stays the same for three seconds.
async function settled(canvas) {
  let last = "";
  for (let same = 0; same < 3; ) {
    await new Promise((done) => setTimeout(done, 1000));
    const now = canvas.toDataURL();
    same = now === last ? same + 1 : 0;
    last = now;
  }
}

export async function post(draw) {
  try {
    const canvas = await draw();
    await settled(canvas);
    const picture = await new Promise((done) => canvas.toBlob(done, "image/png"));
    await fetch("/picture", { method: "POST", body: picture });
  } catch (error) {
    await fetch("/problem", { method: "POST", body: String(error.stack || error) });
  }
}
