// The volume on the GPU: textures from the page's bytes, and the program that draws them.

const BRICK = 8;
// Side of a tile: a brick and its upper neighbours' first voxels, for interpolation.
const TILE = BRICK + 1;
const SPACES = { box: 0, ndc: 1, contraction: 2 };
const MODES = { colour: 0, depth: 1, opacity: 2, reads: 3, probe: 4 };

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

/** Returns the bits of a small number in half precision. */
function half(value) {
  const size = Math.abs(value);
  const exponent = Math.max(Math.floor(Math.log2(Math.max(size, 1e-9))), -14);
  // A mantissa that rounds up to the next power of two carries into the exponent.
  const bits = Math.round((size / 2 ** exponent - (size >= 2 ** -14 ? 1 : 0)) * 1024);
  return (value < 0 ? 0x8000 : 0) + (size >= 2 ** -14 ? (exponent + 15) * 1024 : 0) + bits;
}

/**
 * Returns, for each opacity code times 256 plus byte, a level of colour and one of view dependence, both times opacity, in half
 * precision. The code is 255 times the square root of the opacity, and so are the bytes' ranges.
 */
function levels() {
  const [colours, views] = [new Uint16Array(65536), new Uint16Array(65536)];
  for (let code = 1; code < 256; code++) {
    const opacity = (code / 255) ** 2;
    for (let byte = 0; byte < 256; byte++) {
      colours[256 * code + byte] = half(opacity * Math.min(1, byte / code));
      views[256 * code + byte] = half(opacity * Math.max(-1, Math.min(1, ((byte - 128) / 127) * (255 / code))));
    }
  }
  return { colours, views };
}

/** Splits the volume's bytes into three textures: bricks' positions in the atlas, colours, and view components. */
function unpacked(bytes, resolution, count, most) {
  const side = resolution / BRICK;
  const distances = bytes.subarray(0, side ** 3);
  const plane = (k) => bytes.subarray(side ** 3 + k * count * 512, side ** 3 + (k + 1) * count * 512);
  const planes = [0, 1, 2, 3, 4, 5, 6, 7].map(plane);
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
  const [colours, views] = [new Uint16Array(4 * texels), new Uint16Array(4 * texels)];
  const level = levels();
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
          const code = 256 * planes[0][from];
          if (code === 0) continue;
          for (let c = 0; c < 3; c++) colours[to + c] = level.colours[code + planes[1 + c][from]];
          colours[to + 3] = level.colours[code + 255];
          for (let c = 0; c < 4; c++) views[to + c] = level.views[code + planes[4 + c][from]];
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
    this.setSpace(scene.bounds);
  }

  setVolume({ side, size, bricks, colours, views }) {
    const { gl, scene } = this;
    const cube = [side, side, side];
    this.texture(0, "bricks", [gl.RGBA8UI, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE], gl.NEAREST, cube, bricks);
    this.texture(1, "colours", [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT], gl.LINEAR, size, colours);
    this.texture(2, "views", [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT], gl.LINEAR, size, views);
    gl.uniform3fv(this.at("atlas_size"), size);
    gl.uniform1f(this.at("resolution"), scene.resolution);
    gl.uniform3fv(this.at("components"), scene.components);
  }

  texture(unit, name, [kept, format, type], filter, [width, height, depth], data) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_3D, gl.createTexture());
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage3D(gl.TEXTURE_3D, 0, kept, width, height, depth, 0, format, type, data);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) {
      gl.texParameteri(gl.TEXTURE_3D, side, gl.CLAMP_TO_EDGE);
    }
    gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MAG_FILTER, filter);
    gl.uniform1i(this.at(name), unit);
  }

  /**
   * Sets the field's space. Lengths on the GPU are relative to the space's unit and origin: world coordinates may be too large for
   * floats.
   */
  setSpace({ min, max, near, far, space }) {
    const { gl } = this;
    const sides = plus(max, min, -1);
    const side = Math.max(...sides);
    // `cube` is the length of the unit cube's side, near the cameras.
    const set = (kind, origin, unit, cube) => {
      Object.assign(this, { origin, unit, voxel: cube / this.scene.resolution });
      gl.uniform1i(this.at("space"), kind);
    };
    if (space.ndc) {
      const { camera_to_world: m, min: low, max: high, near: front, far: back } = space.ndc;
      set(SPACES.ndc, column(m, 3), front, front * Math.max(high[0] - low[0], high[1] - low[1]));
      // Rows of the camera's axes; depth is along the negative z axis.
      this.axes = [column(m, 0), column(m, 1), scaled(column(m, 2), -1)];
      gl.uniformMatrix3fv(this.at("turn"), false, [0, 1, 2].flatMap((i) => this.axes.map((axis) => axis[i])));
      gl.uniform4f(this.at("slopes"), ...low, ...high);
      gl.uniform1f(this.at("far"), back / front);
    } else if (space === "contraction") set(SPACES.contraction, scaled(plus(min, max), 0.5), 0.5 * side, 2 * side);
    else {
      set(SPACES.box, min, side, side);
      gl.uniform3fv(this.at("extent"), scaled(sides, 1 / side));
    }
    gl.uniform2f(this.at("range"), near / this.unit, Math.min(far / this.unit, 1e30));
  }

  /** Returns a world point in the coordinates of the GPU. */
  centreOf(point) {
    const from = scaled(plus(point, this.origin, -1), 1 / this.unit);
    return this.axes ? this.axes.map((axis) => dot(axis, from)) : from;
  }

  /**
   * Draws the view of a pinhole camera, with `camera_to_world` (three rows of four numbers) and `intrinsics` as in
   * views.json, into `width` × `height` pixels of the canvas, over `background`: red, green and blue from 0 to 1.
   */
  draw({ camera_to_world: m, intrinsics: k }, mode, depths, background = Array(3).fill(this.scene.background)) {
    const { gl, canvas } = this;
    if (mode !== "probe" && (canvas.width !== k.width || canvas.height !== k.height)) [canvas.width, canvas.height] = [k.width, k.height];
    gl.viewport(0, 0, k.width, k.height);
    gl.uniformMatrix3fv(this.at("rotation"), false, [0, 1, 2].flatMap((c) => m.map((row) => row[c])));
    gl.uniform3fv(this.at("centre"), this.centreOf(column(m, 3)));
    gl.uniform4f(this.at("intrinsics"), k.fx, k.fy, k.cx, k.cy);
    gl.uniform1f(this.at("height"), k.height);
    gl.uniform1i(this.at("mode"), MODES[mode]);
    gl.uniform3fv(this.at("background"), background);
    gl.uniform2fv(this.at("depth_range"), scaled(depths, 1 / this.unit));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Returns the distances of the surfaces along a few rays of a camera; Infinity where there is none. */
  distances({ camera_to_world, intrinsics: k }, count, unit) {
    const { gl } = this;
    const ratio = [count / k.width, count / k.height];
    const intrinsics = {
      width: count, height: count, fx: k.fx * ratio[0], fy: k.fy * ratio[1], cx: k.cx * ratio[0], cy: k.cy * ratio[1],
    };
    this.probe ??= this.newProbe(count);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.probe);
    this.draw({ camera_to_world, intrinsics }, "probe", [unit, unit]);
    const bytes = new Uint8Array(4 * count * count);
    gl.readPixels(0, 0, count, count, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const found = [];
    for (let i = 0; i < bytes.length; i += 4) {
      const share = (bytes[i] * 65536 + bytes[i + 1] * 256 + bytes[i + 2]) / 16711680;
      found.push(share > 0 ? unit * (1 / share - 1) : Infinity);
    }
    return found;
  }

  /** Creates a target of a few pixels. */
  newProbe(count) {
    const { gl } = this;
    const [target, pixels] = [gl.createFramebuffer(), gl.createRenderbuffer()];
    gl.bindRenderbuffer(gl.RENDERBUFFER, pixels);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, count, count);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, pixels);
    return target;
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
