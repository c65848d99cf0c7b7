// The volume on the GPU: textures from the page's bytes, and the program that draws them.

const BRICK = 8;
// Side of a tile: a brick and its upper neighbours' first voxels, for interpolation.
const TILE = BRICK + 1;
const MODES = { colour: 0, depth: 1, opacity: 2, reads: 3 };

/** Decodes and inflates a base64 text. */
async function inflated(text) {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Returns the number of tiles along each axis of an atlas that is as cubic as possible. */
function tilesOf(count, most) {
  const x = Math.min(most, Math.ceil(Math.cbrt(count)));
  const y = Math.min(most, Math.ceil(Math.sqrt(count / x)));
  return [x, y, Math.max(1, Math.ceil(count / (x * y)))];
}

/** Splits the volume's bytes into three textures: bricks' positions in the atlas, colours, and view components. */
function unpacked(bytes, resolution, count, most) {
  const side = resolution / BRICK;
  const distances = bytes.subarray(0, side ** 3);
  const plane = (k) => bytes.subarray(side ** 3 + k * count * 512, side ** 3 + (k + 1) * count * 512);
  const planes = [1, 2, 3, 0, 4, 5, 6, 7].map(plane);
  const tiles = tilesOf(count, most);
  const slots = new Int32Array(side ** 3).fill(-1);
  const places = [];
  for (let i = 0; i < slots.length; i++) {
    if (distances[i] === 0) slots[i] = places.push(i) - 1;
  }
  const corner = (slot) =>
    [slot % tiles[0], Math.floor(slot / tiles[0]) % tiles[1], Math.floor(slot / (tiles[0] * tiles[1]))];
  const bricks = new Uint8Array(4 * slots.length);
  for (let i = 0; i < slots.length; i++) {
    bricks.set([...(slots[i] < 0 ? [0, 0, 0] : corner(slots[i])), distances[i]], 4 * i);
  }
  const size = tiles.map((n) => n * TILE);
  const texels = size[0] * size[1] * size[2];
  const [colours, views] = [new Uint8Array(4 * texels), new Uint8Array(4 * texels).fill(128)];
  // Source of a tile's voxel: the tile's own brick, or an upper neighbour.
  places.forEach((place, slot) => {
    const at = [place % side, Math.floor(place / side) % side, Math.floor(place / side ** 2)];
    const behind = (bits) => {
      const to = at.map((c, axis) => c + ((bits >> axis) & 1));
      return to.every((c) => c < side) ? slots[to[0] + side * (to[1] + side * to[2])] : -1;
    };
    const sources = [0, 1, 2, 3, 4, 5, 6, 7].map(behind);
    const [cx, cy, cz] = corner(slot).map((c) => c * TILE);
    for (let z = 0; z < TILE; z++) {
      for (let y = 0; y < TILE; y++) {
        for (let x = 0; x < TILE; x++) {
          const source = sources[(x >> 3) | ((y >> 3) << 1) | ((z >> 3) << 2)];
          if (source < 0) continue;
          const from = source * 512 + (x & 7) + 8 * (y & 7) + 64 * (z & 7);
          const to = 4 * (cx + x + size[0] * (cy + y + size[1] * (cz + z)));
          for (let c = 0; c < 4; c++) {
            colours[to + c] = planes[c][from];
            views[to + c] = planes[4 + c][from];
          }
        }
      }
    }
  });
  return { side, size, bricks, colours, views };
}

function compiled(gl, kind, text) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}

/** Draws a scene's volume into a canvas. */
class Volume {
  constructor(canvas, scene, bytes) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL2, which the view is drawn by. A current Firefox, Chrome or Safari has it.");
    Object.assign(this, { gl, canvas, scene });
    const most = Math.min(255, Math.floor(gl.getParameter(gl.MAX_3D_TEXTURE_SIZE) / TILE));
    if (scene.bricks > most ** 3) throw new Error("The volume is too large for this graphics card; bake it at a lower resolution.");
    const program = gl.createProgram();
    gl.attachShader(program, compiled(gl, gl.VERTEX_SHADER, text("vertex-shader")));
    gl.attachShader(program, compiled(gl, gl.FRAGMENT_SHADER, text("fragment-shader")));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.at = (name) => gl.getUniformLocation(program, name);
    this.setVolume(unpacked(bytes, scene.resolution, scene.bricks, most));
    this.setBox(scene.bounds);
  }

  setVolume({ side, size, bricks, colours, views }) {
    const { gl, scene } = this;
    const cube = [side, side, side];
    this.texture(0, "bricks", gl.RGBA8UI, gl.RGBA_INTEGER, gl.NEAREST, cube, bricks);
    this.texture(1, "colours", gl.RGBA8, gl.RGBA, gl.LINEAR, size, colours);
    this.texture(2, "views", gl.RGBA8, gl.RGBA, gl.LINEAR, size, views);
    gl.uniform3fv(this.at("atlas_size"), size);
    gl.uniform1f(this.at("resolution"), scene.resolution);
    gl.uniform3fv(this.at("components"), scene.components);
    gl.uniform3fv(this.at("background"), [1, 1, 1].map(() => scene.background));
  }

  texture(unit, name, kept, format, filter, [width, height, depth], bytes) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_3D, gl.createTexture());
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage3D(gl.TEXTURE_3D, 0, kept, width, height, depth, 0, format, gl.UNSIGNED_BYTE, bytes);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) {
      gl.texParameteri(gl.TEXTURE_3D, side, gl.CLAMP_TO_EDGE);
    }
    gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MAG_FILTER, filter);
    gl.uniform1i(this.at(name), unit);
  }

  /** Lengths on the GPU are relative to the box's longest side and corner: world coordinates may be too large for floats. */
  setBox({ min, max, near, far }) {
    const { gl } = this;
    const sides = plus(max, min, -1);
    this.corner = min;
    this.side = Math.max(...sides);
    gl.uniform3fv(this.at("extent"), scaled(sides, 1 / this.side));
    gl.uniform2f(this.at("range"), near / this.side, Math.min(far / this.side, 1e30));
  }

  /**
   * Draws the view of a pinhole camera, with `camera_to_world` (three rows of four numbers) and `intrinsics` as in
   * views.json, into `width` × `height` pixels of the canvas.
   */
  draw({ camera_to_world: m, intrinsics: k }, mode, depths) {
    const { gl, canvas } = this;
    if (canvas.width !== k.width || canvas.height !== k.height) [canvas.width, canvas.height] = [k.width, k.height];
    gl.viewport(0, 0, k.width, k.height);
    gl.uniformMatrix3fv(this.at("rotation"), false, [0, 1, 2].flatMap((c) => m.map((row) => row[c])));
    gl.uniform3fv(this.at("centre"), scaled(plus(column(m, 3), this.corner, -1), 1 / this.side));
    gl.uniform4f(this.at("intrinsics"), k.fx, k.fy, k.cx, k.cy);
    gl.uniform1f(this.at("height"), k.height);
    gl.uniform1i(this.at("mode"), MODES[mode]);
    gl.uniform2fv(this.at("depth_range"), scaled(depths, 1 / this.side));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Waits until drawing has finished. Reading a pixel would wait, too, but blocks the page. */
  async finished() {
    const { gl } = this;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (!gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) {
      await new Promise((resolve) => setTimeout(resolve, 1));
    }
    gl.deleteSync(fence);
  }

  /** Returns the drawn pixels: RGBA, row by row from the top. */
  pixels() {
    const { width, height } = this.canvas;
    const context = new OffscreenCanvas(width, height).getContext("2d");
    context.drawImage(this.canvas, 0, 0);
    return context.getImageData(0, 0, width, height).data;
  }
}
