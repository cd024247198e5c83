#!/usr/bin/env python3
"""make-fixtures.py NAME...: write tests/fixtures/, the reference values that the tests compare with.

    safetensors    reference.safetensors   pip install torch==2.13.0 safetensors numpy
    torch_rng      torch_rng.json          pip install torch==2.13.0 numpy; on a processor with AVX2
    torch_file     torch_*.pth             pip install torch==2.13.0
    adamw          adamw.json              pip install torch==2.13.0
    solvers        solvers.json            pip install torch==2.13.0 diffusers==0.42.1
    h5             foreign.h5              pip install h5py==3.16.0 numpy
    corpus         ../corpus/              the files of torch_file

Run from the root of the tree.  The tests need none of this: the files are committed.
"""
import sys


def safetensors():
    import torch
    from safetensors.torch import save_file

    x = torch.arange(6).reshape(2, 3) / 4 - 0.5
    save_file(
        {
            "f64": x.double(),
            "f32": x,
            "bf16": x.bfloat16(),
            "f16": x.half(),
            "scalar": torch.tensor(7.0),
            "steps": torch.arange(3),
        },
        "tests/fixtures/reference.safetensors",
        metadata={"made by": "the reference writer"},
    )


def h5():
    """Arrays 1000 + their index, laid out as other writers may: chunks of any shape, with and without filters."""
    import h5py
    import numpy as np

    x = (1000 + np.arange(5 * 3 * 7)).reshape(5, 3, 7)
    with h5py.File("tests/fixtures/foreign.h5", "w") as f:
        f.create_dataset("odd", data=x.astype("u2"), chunks=(2, 2, 4), compression="gzip")
        f.create_dataset("shuffled", data=x.astype("f4"), chunks=(3, 3, 7), shuffle=True)
        f.create_dataset("bare", data=x.astype("u4"), chunks=(1, 1, 5))
        f.create_dataset("whole", data=x.astype("i2"))
        f.create_dataset("summed", data=x.astype("u2"), chunks=(1, 3, 7), fletcher32=True)


def torch_rng():
    """Calls of torch.randn after a seed: the values, or of a long one the FNV-1a hash of its bytes."""
    import json

    import torch

    runs = [
        (42, [("f32", 16), ("f32", 5), ("f32", 2), ("f32", 37), ("f64", 3), ("f64", 20), ("f32", 15), ("f64", 32)]),
        (0, [("f32", 1), ("f32", 17), ("f32", 1), ("f32", 1)]),
        (5000000007, [("f64", 17), ("f32", 24)]),
        (1, [("f32", 100003), ("f32", 9)]),
    ]
    out = []
    for seed, calls in runs:
        torch.manual_seed(seed)
        done = []
        for dtype, n in calls:
            x = torch.randn(n, dtype=torch.float64 if dtype == "f64" else torch.float32)
            call = {"dtype": dtype, "n": n}
            if n < 1000:
                call["values"] = [v.hex() for v in x.tolist()]
            else:
                h = 0xCBF29CE484222325
                for byte in x.numpy().tobytes():
                    h = (h ^ byte) * 0x100000001B3 % 2**64
                call["hash"] = f"{h:016x}"
            done.append(call)
        out.append({"seed": seed, "calls": done})
    with open("tests/fixtures/torch_rng.json", "w") as f:
        f.write(f"// torch {torch.__version__}: scripts/make-fixtures.py torch_rng\n")
        f.write(json.dumps(out, separators=(",", ":")).replace('{"dtype"', '\n{"dtype"') + "\n")


def torch_file():
    """A state dict of three types in both containers, and one inside a checkpoint with other things beside it."""
    import torch

    x = torch.arange(6).reshape(2, 3) / 4 - 0.5
    state = {"f32": x, "bf16": x.bfloat16(), "half": x[1].half(), "steps": torch.tensor(7), "tied": x}
    torch.save(state, "tests/fixtures/torch_zip.pth")
    torch.save(state, "tests/fixtures/torch_old.pth", _use_new_zipfile_serialization=False)
    model = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.BatchNorm1d(2))
    model.load_state_dict({k: torch.full_like(v, 1.5) for k, v in model.state_dict().items()})
    model[0].weight.data[1, 2] = -2
    torch.save({"epoch": 3, "rates": [1e-4, 5e-5], "state_dict": model.state_dict()}, "tests/fixtures/torch_inner.pth")
    torch.save({"p": torch.nn.Parameter(x)}, "tests/fixtures/torch_parameter.pth")
    torch.save({"turned": x.t()}, "tests/fixtures/torch_strided.pth")


def adamw():
    """Ten steps of torch's AdamW in f64 with clipping and warm-up, for gradients w + step / 3 of two tensors."""
    import json

    import torch

    wide = torch.float64
    first = [torch.linspace(-1, 1, 6, dtype=wide).reshape(2, 3), torch.tensor([0.5, -0.25], dtype=wide)]
    runs = []
    for decay, max_norm, warmup in ((0.03, 0.05, 4), (0.0, 0.0, 0), (0.1, 3.0, 20)):
        w = [x.clone().requires_grad_() for x in first]
        o = torch.optim.AdamW(w, lr=1e-2, betas=(0.9, 0.999), eps=1e-10, weight_decay=decay)
        run = {"decay": decay, "max_norm": max_norm, "warmup": warmup, "norms": [], "weights": []}
        for k in range(10):
            for x in w:
                x.grad = x.detach() + k / 3
            limit = max_norm if max_norm else float("inf")
            run["norms"].append(torch.nn.utils.clip_grad_norm_(w, limit).item())
            o.param_groups[0]["lr"] = 1e-2 * (min(1.0, k / warmup) if warmup else 1.0)
            o.step()
            run["weights"].append([v for x in w for v in x.flatten().tolist()])
        runs.append(run)
    with open("tests/fixtures/adamw.json", "w") as f:
        json.dump(runs, f, indent=0)


def solvers():
    """The public schedulers in f64: states before and after every step, for velocities that are tanh(2 z) + sigma."""
    import json

    import torch
    from diffusers import DPMSolverMultistepScheduler, FlowMatchEulerDiscreteScheduler, UniPCMultistepScheduler

    flow = dict(use_flow_sigmas=True, prediction_type="flow_prediction", flow_shift=5.0)
    made = {
        "euler": FlowMatchEulerDiscreteScheduler(shift=5.0),
        "unipc": UniPCMultistepScheduler(**flow),
        "dpm++": DPMSolverMultistepScheduler(**flow),
    }
    out = []
    for name, scheduler in made.items():
        for steps in (1, 2, 5, 9):
            scheduler.set_timesteps(steps)
            if name == "dpm++":  # the full range, that its first step leaves from sigma = 1
                scheduler.sigmas[0] = 1
            scheduler.sigmas = sigma = scheduler.sigmas.double()
            z = torch.linspace(-2, 2, 7, dtype=torch.float64)[None, None]
            states = [z.flatten().tolist()]
            for i, t in enumerate(scheduler.timesteps):
                z = scheduler.step(torch.tanh(2 * z) + sigma[i], t, z, return_dict=False)[0]
                states.append(z.flatten().tolist())
            out.append({"solver": name, "sigma": sigma.tolist(), "states": states})
    with open("tests/fixtures/solvers.json", "w") as f:
        json.dump(out, f, indent=0)


def corpus():
    """What the fuzzers start from: one small file of every kind, sound and damaged."""
    import os
    import struct

    def put(folder, files):
        os.makedirs(f"tests/corpus/{folder}", exist_ok=True)
        for name, data in files.items():
            with open(f"tests/corpus/{folder}/{name}", "wb") as f:
                f.write(data)

    put("json", {
        "empty": b"",
        "object": b'{"a": {"b": [1, -2.5e-3, true, null]}, "c": "d"}',
        "comments": b'// one\n{/* two */"a": 1} // three',
        "escapes": rb'["\"\\\/\b\f\n\r\t\u00e9\ud83d\ude00", "\u0000", "\ud800"]',
        "utf8": '["\u00e9\u20ac\U0001f600"]'.encode(),
        "not_utf8": b'["\xc0\x80\xff"]',
        "deep": b"[" * 65 + b"]" * 65,
        "deepest": b"[" * 64 + b"]" * 64,
        "twice": rb'{"a": 1, "\u0061": 2}',
        "numbers": b"[0, -0, 1e308, 1e309, 5e-324, 9007199254740993, 01]",
        "long_number": b"[" + b"1" * 64 + b"]",
        "cut": b'{"a": [1, {"b": "c',
        "set": b'{"a": {"b": 1}, "l": [0]}\0a.b=[1, {"x": null}]\0l.0=text\0n.e.w=1',
    })

    def file(header, data=0):
        return struct.pack("<Q", len(header)) + header.encode() + bytes(data)

    def record(dtype, shape, begin, end):
        return f'{{"dtype":"{dtype}","shape":{shape},"data_offsets":[{begin},{end}]}}'

    f32 = record("F32", [2], 0, 8)
    def text(s):
        return b"X" + struct.pack("<I", len(s)) + s.encode()

    ref = b"(" + text("storage") + b"ctorch\nFloatStorage\n" + text("0") + text("cpu") + b"K\x02tQ"
    rebuild = b"ctorch._utils\n_rebuild_tensor_v2\n("
    tensor = rebuild + ref + b"K\x00K\x02\x85K\x01\x85\x89}tR"
    files = {}
    for name in ("zip", "old", "inner", "parameter", "strided"):
        with open(f"tests/fixtures/torch_{name}.pth", "rb") as f:
            files[name] = f.read()
    put("torch_file", files | {
        "cut_zip": files["zip"][:-30],
        "one": b"\x80\x02}" + text("a") + tensor + b"s.",
        "two": b"\x80\x02}(" + text("a") + tensor + text("b") + tensor + b"u.",
        "ordered": b"\x80\x02ccollections\nOrderedDict\n](](" + text("a") + tensor + b"ee\x85R.",
        "memo": b"\x80\x02}q\x00" + text("a") + b"q\x01" + tensor + b"q\x02sh\x01h\x02s.",
        "untyped": b"\x80\x02}" + text("a") + b"ctorch._utils\n_rebuild_tensor_v3\n("
                   + ref.replace(b"torch\nFloatStorage", b"torch.storage\nUntypedStorage").replace(b"K\x02", b"K\x08")
                   + b"K\x00K\x02\x85K\x01\x85\x89}ctorch\nfloat32\ntRs.",
        "nested": b"\x80\x02}" + text("model") + b"}" + text("a") + tensor + b"s" + text("epoch")
                  + b"\x8a\x02\xff\x7fs.",
        "attributes": b"\x80\x02ccollections\nOrderedDict\n)R" + text("a") + tensor + b"s}" + text("_metadata")
                      + b"}sb.",
        "call": b"\x80\x02cos\nsystem\n" + text("ls") + b"\x85R.",
        "laugh": b"\x80\x02)" + b"".join(b"q%ch%c\x86" % (i, i) for i in range(30)) + b".",
    })

    put("safetensors", {
        "empty": file("{}"),
        "padded": file('{"a":' + f32 + "}   ", 8),
        "several": file('{"__metadata__":{"k":"v"},"a":' + f32 + ',"b":' + record("BF16", [3, 1], 8, 14)
                        + ',"c":' + record("I64", [], 14, 22) + "}", 22),
        "askew": file('{"a":' + record("U8", [1], 0, 1) + ',"b":' + record("F64", [1], 1, 9) + "}", 9),
        "hole": file('{"a":' + f32 + ',"b":' + record("U8", [1], 9, 10) + "}", 10),
        "overlap": file('{"a":' + f32 + ',"b":' + f32 + "}", 8),
        "trailing": file('{"a":' + f32 + "}", 9),
        "short": file('{"a":' + f32 + "}", 7),
        "huge_length": b"\xff" * 8 + b"{}",
        "product": file('{"a":' + record("F32", [2**32, 2**32], 0, 8) + "}", 8),
        "three_factors": file('{"a":' + record("U8", [2**22, 2**22, 2**21], 0, 8) + "}", 8),
        "zero": file('{"a":' + record("F32", [0], 0, 0) + "}"),
        "nine_dims": file('{"a":' + record("F32", [1] * 9, 0, 4) + "}", 4),
        "sign": file('{"a":' + record("F32", [-2], 0, 8) + "}", 8),
        "twice": file('{"a":' + f32 + ',"a":' + f32 + "}", 8),
        "deep": file('{"a":' + "[" * 70 + "}"),
        "name": file('{"a\\nb":' + f32 + "}", 8),
    })

    put("gltf", gltf_files())
    put("exr", exr_files())
    put("obj", obj_files())
    put("image", image_files())
    put("bundle", bundle_files())


def gltf_files():
    """JSON, a zero byte, the binary chunk."""
    import json
    import struct

    def file(arrays, **rest):
        """arrays: (type, component, numbers, more); one view and accessor each."""
        code = {5120: "b", 5121: "B", 5122: "h", 5123: "H", 5125: "I", 5126: "f"}
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
        data, views, accessors = b"", [], []
        for kind, component, x, *more in arrays:
            raw = struct.pack(f"<{len(x)}{code[component]}", *x)
            views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(raw)})
            accessors.append({"bufferView": len(views) - 1, "type": kind, "componentType": component,
                              "count": len(x) // width[kind], **(more[0] if more else {})})
            data += raw + bytes(-len(raw) % 4)
        buffers = [{"byteLength": len(data)}] if data else []
        top = {"asset": {"version": "2.0"}, "buffers": buffers, "bufferViews": views, "accessors": accessors, **rest}
        return json.dumps({k: v for k, v in top.items() if v}, separators=(",", ":")).encode() + b"\0" + data

    x = ("VEC3", 5126, [0, 0, 0, 1, 0, 0, 0, 1, 0])
    n = ("VEC3", 5126, [0, 0, 1] * 3)
    times = ("SCALAR", 5126, [0, 1])
    nodes = [{"mesh": 0}]

    def mesh(**more):
        return [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1}, **more}]}]

    def animation(path, how, node=0):
        return [{"channels": [{"sampler": 0, "target": {"node": node, "path": path}}],
                 "samplers": [{"input": 2, "output": 3, "interpolation": how}]}]

    joints, weights = ("VEC4", 5121, [1, 0, 0, 0] * 3), ("VEC4", 5121, [255, 0, 0, 0] * 3, {"normalized": True})
    skinned = [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "JOINTS_0": 4, "WEIGHTS_0": 5}}]}]
    turn = ("VEC4", 5122, [0, 0, 0, 32767, 0, 0, 32767, 0], {"normalized": True})
    sparse = {"count": 1, "indices": {"bufferView": 2, "componentType": 5121}, "values": {"bufferView": 3}}
    draco = ["KHR_draco_mesh_compression"]
    files = {
        "plain": file([x, n], meshes=mesh(), nodes=nodes),
        "flat": file([x], meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}], nodes=nodes),
        "indexed": file([x, n, ("SCALAR", 5121, [2, 1, 0])], meshes=mesh(indices=2), nodes=nodes),
        "strip": file([x, n], meshes=mesh(mode=5), nodes=nodes),
        "tree": file([x, n], meshes=mesh(), scenes=[{"nodes": [0]}], scene=0, nodes=[
            {"children": [1], "scale": [1, -2, 1]},
            {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]}]),
        "cycle": file([], nodes=[{"children": [1]}, {"children": [0]}]),
        "zero_scale": file([x, n], meshes=mesh(), nodes=[{"mesh": 0, "scale": [0, 0, 0]}]),
        "step": file([x, n, times, ("VEC3", 5126, [0, 0, 0, 1, 2, 3])], meshes=mesh(), nodes=nodes,
                     animations=animation("translation", "STEP")),
        "cubic": file([x, n, times, ("VEC3", 5126, [1] * 18)], meshes=mesh(), nodes=nodes,
                      animations=animation("scale", "CUBICSPLINE")),
        "morph": file([x, n, times, ("SCALAR", 5126, [0, 1])], meshes=mesh(targets=[{"POSITION": 1, "NORMAL": 0}]),
                      nodes=nodes, animations=animation("weights", "LINEAR")),
        "skin": file([x, n, times, turn, joints, weights], meshes=skinned, skins=[{"joints": [1, 2]}],
                     nodes=[{"mesh": 0, "skin": 0}, {"children": [2]}, {}],
                     animations=animation("rotation", "LINEAR", 2)),
        "sparse": file([x, n, ("SCALAR", 5121, [1]), ("VEC3", 5126, [7, 8, 9])], meshes=mesh(), nodes=nodes).replace(
            b'"count":3}', b'"count":3,"sparse":' + json.dumps(sparse).encode() + b"}", 1),
        "cameras": file([], nodes=[{"camera": 0}, {"camera": 1}], cameras=[
            {"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}},
            {"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "znear": 0, "zfar": 1}}]),
        "copies": file([x, n], meshes=mesh(), nodes=[{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {
            "attributes": {"TRANSLATION": 0}}}}]),
        "required": file([], extensionsRequired=draco),
        "far": file([("VEC3", 5126, [1e13] * 9), n], meshes=mesh(), nodes=nodes),
        "nan": file([("VEC3", 5126, [float("nan")] * 9), n], meshes=mesh(), nodes=nodes),
        "data_uri": b'{"asset":{"version":"2.0"},"buffers":[{"byteLength":4,"uri":"data:;base64,AAAAAA=="}]}',
        "beside": b'{"asset":{"version":"2.0"},"buffers":[{"byteLength":4,"uri":"../%2e/x"}]}',
    }
    body, data = files["plain"].split(b"\0", 1)
    body += b" " * (-len(body) % 4)
    chunks = struct.pack("<II", len(body), 0x4E4F534A) + body + struct.pack("<II", len(data), 0x004E4942) + data
    files["glb"] = b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks
    files["glb_cut"] = files["glb"][:-9]
    files["glb_length"] = b"glTF" + struct.pack("<II", 2, 2**32 - 1) + chunks
    return files


def bundle_files():
    """meta.json, a form feed, cameras.json."""
    import json

    def cameras(frames):
        return json.dumps({"format": "dar-cameras/1", "width": 4, "height": 3, "cameras": [
            {"K": [[4, 0, 2], [0, 4, 1.5], [0, 0, 1]], "near": 0.1,
             "c2w": [[1, 0, 0, t], [0, 1, 0, 0], [0, 0, 1, -3], [0, 0, 0, 1]]} for t in range(frames)]})

    def file(views=1, **more):
        least = {"format": "dar-bundle/1", "width": 4, "height": 3, "frames": 1, "fps": 24}
        return (json.dumps(least | more) + "\f" + cameras(views)).encode()

    def families(**f):
        return file(families=f)

    def inside(type, **more):
        return {"type": type} | more

    whole = file(
        5, frames=5, up="z", unit=1, rgb=True, reference=True, text=True, tracks=20, seed=2**53 - 1,
        families={
            "tracking": inside("u16", file="gbuffer.h5", scheme="rest-cells", scale=[1.5e-5] * 3, offset=[0] * 3),
            "world": inside("u16", scale=[1e-4] * 3, offset=[-1, -2, -3]), "normal": inside("i16"),
            "depth": inside("f32"), "mask": inside("u8"), "sparse": inside("u8"), "id": inside("u32"),
            "part": inside("u32")},
        conventions={"camera": "opencv", "pixel_centre": "half", "depth": "view-z", "normal": "world",
                     "background": "zero", "rgb": "srgb-display"},
        generator="dar-bundle 0.1", source={"path": "a.glb", "sha256": "00", "licence": "CC0", "animation": "walk"},
        trajectory="orbit", prompt="a \u00f6", world={"center": [0, 1, 2], "size": 3, "box": [-1, -1, -1, 1, 1, 1]},
        depth_range=[1, 4], objects=[{"name": "ball", "parts": 2}, {"name": "ring"}], boxes=[[0, 0, 0, 1, 1, 1]] * 5,
        files={"cameras.json": {"bytes": 10, "sha256": "0" * 64}, "exr/00004.exr": {"bytes": 7}},
        qc={"ok": False, "reasons": ["dark"]}, extra={"a": [1, {}]})
    return {
        "empty": b"",
        "least": file(),
        "whole": whole,
        "whole_no_cameras": whole.split(b"\f")[0],
        "exr": families(depth=inside("f32", file="exr"), mask=inside("u8", file="exr"), id=inside("u32", file="exr")),
        "f32": families(world=inside("f32"), normal=inside("f32"), tracking=inside("u8")),
        "world_u16_bare": families(world=inside("u16")),
        "scale_zero": families(normal=inside("i16", scale=[1, 0, 1], offset=[0, 0, 0])),
        "exr_u16": families(normal=inside("i16", file="exr")),
        "sparse_exr": families(sparse=inside("f32", file="exr")),
        "next_version": file(format="dar-bundle/2"),
        "no_format": b'{"frames": 1}',
        "frames_differ": file(5, frames=9),
        "size_differs": file(width=5),
        "huge": file(width=16384, height=16384, frames=65536),
        "beyond": file(width=1e9, frames=-1),
        "boxes_short": file(5, frames=5, boxes=[[0] * 6]),
        "box_upside_down": file(boxes=[[1, 0, 0, 0, 0, 0]]),
        "world_flat": file(world={"center": [0, 0, 0], "size": 0, "box": [0] * 6}),
        "depth_backwards": file(depth_range=[3, 1]),
        "file_outside": file(files={"../../etc/passwd": {"bytes": 1}}),
        "file_exr_beyond": file(files={"exr/00001.exr": {"bytes": 1}}),
        "sha_short": file(files={"rgb.h5": {"bytes": 1, "sha256": "abc"}}),
        "typo": file(famlies={}),
        "types": file(width="4", height=[], frames={}, fps=None, families=[]),
        "nulls": file(families=None, world=None, boxes=None, objects=None, files=None, source=None),
        "seed_large": file(seed=2**60),
        "cut": whole[:700],
        "cut_cameras": file()[:-60],
    }


def obj_files():
    square = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
    return {
        "empty": b"",
        "square": square + b"f 1 2 3 4\n",
        "normals": square + b"vn 0 0 1\nf 1//1 2//1 3//1 4//1\n",
        "texture": square + b"vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf 1/1 3/1 4/1\n",
        "backwards": square + b"f -1 -2 -3\n",
        "dart": b"v 0 0 0\nv 2 0 0\nv .5 .5 0\nv 0 2 0\nf 1 2 3 4\n",
        "crossing": b"v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nv 3 3 3\nf 1 2 3 4 5\n",
        "lines": square + b"# c\no a\ng b\nl 1 2\np 1\nusemtl x\nf 1 2 3\r\n",
        "range": square + b"f 1 2 5\n",
        "zero": square + b"f 0 1 2\n",
        "numbers": b"v 1e300 nan 0x10\nv -.5e-3 +7. 123456789012345678901234567890\n",
        "pattern": b"f_%04d*?.obj\0f_0012xy.obj",
    }


def exr_files():
    """OpenEXR written by hand; the pixels are 1, 2, 3 ... in every channel that has any."""
    import struct

    def attr(name, kind, value):
        return f"{name}\0{kind}\0".encode() + struct.pack("<I", len(value)) + value

    def header(data, display, channels, compression, more):
        """`data` and `display`: x0 y0 x1 y1, both ends included; a channel: name, pixel type, sampling."""
        listed = b"".join(n.encode() + b"\0" + struct.pack("<iB3xii", t, 0, k, k) for n, t, k in channels) + b"\0"
        return (
            attr("channels", "chlist", listed) + attr("compression", "compression", bytes([compression]))
            + attr("dataWindow", "box2i", struct.pack("<4i", *data))
            + attr("displayWindow", "box2i", struct.pack("<4i", *display))
            + attr("lineOrder", "lineOrder", b"\0") + attr("pixelAspectRatio", "float", struct.pack("<f", 1))
            + attr("screenWindowCenter", "v2f", bytes(8)) + attr("screenWindowWidth", "float", struct.pack("<f", 1))
            + more + b"\0"
        )

    def rows(data, start, number):
        """Chunks of one row of one float channel; `number`: of the part, or nothing."""
        x0, y0, x1, y1 = data
        w = x1 - x0 + 1
        return [
            number + struct.pack("<2i", y, 4 * w) + struct.pack(f"<{w}f", *range(start + i * w, start + i * w + w))
            for i, y in enumerate(range(y0, y1 + 1))
        ]

    def table(chunks, at):
        offsets = b""
        at += 8 * len(chunks)
        for c in chunks:
            offsets += struct.pack("<Q", at)
            at += len(c)
        return offsets

    def file(data, display, channels=(("Z", 2, 1),), compression=0, more=b"", flags=0, pixels=True):
        head = struct.pack("<II", 20000630, 2 | flags) + header(data, display, channels, compression, more)
        chunks = rows(data, 1, b"") if pixels else []
        return head + table(chunks, len(head)) + b"".join(chunks)

    def several(data, names):
        head = struct.pack("<II", 20000630, 2 | 0x1000)
        for channel, part in names:
            more = attr("name", "string", part) + attr("type", "string", b"scanlineimage")
            more += attr("chunkCount", "int", struct.pack("<i", data[3] - data[1] + 1))
            head += header(data, data, [(channel, 2, 1)], 0, more)
        chunks = [c for i in range(len(names)) for c in rows(data, 1 + 100 * i, struct.pack("<i", i))]
        head += b"\0"
        return head + table(chunks, len(head)) + b"".join(chunks)

    small = (0, 0, 2, 1)
    plain = file(small, small)
    tiles = attr("tiles", "tiledesc", struct.pack("<IIB", 2, 2, 0))
    return {
        "empty": b"",
        "plain": plain,
        "window": file((1, 1, 3, 2), (0, 0, 4, 3)),
        "negative": file((-3, -2, -1, -1), (-3, -2, -1, -1)),
        "parts": several(small, [("Depth.Z", b"left"), ("Normal.X", b"right")]),
        "outside": file((0, 0, 3, 1), small),
        "huge": file((0, 0, 2**31 - 2, 2**31 - 2), (0, 0, 2**31 - 2, 2**31 - 2), pixels=False),
        "dwaa": file(small, small, compression=8),
        "dwab": file(small, small, compression=9),
        "zip": file(small, small, compression=3),
        "subsampled": file((0, 0, 3, 1), (0, 0, 3, 1), [("Z", 2, 2)]),
        "many": file(small, small, [(f"L{i:02}.X", i % 3, 1) for i in range(40)]),
        "tiled": file(small, small, more=tiles, flags=0x200, pixels=False) + bytes(64),
        "cut": plain[:-5],
        "cut_header": plain[:60],
    }


def image_files():
    """PNG files, a JPEG of 16 x 8 pixels that libjpeg-turbo wrote, and heads of others."""
    import struct
    import zlib

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    def png(w, h, depth, color, raw, more=b"", interlace=0):
        head = chunk(b"IHDR", struct.pack(">IIBBBBB", w, h, depth, color, 0, 0, interlace))
        return b"\x89PNG\r\n\x1a\n" + head + more + chunk(b"IDAT", zlib.compress(raw, 9)) + chunk(b"IEND", b"")

    jpeg = bytes.fromhex(
        "ffd8ffe000104a46494600010100000100010000ffdb0043000101010101010101010101010101010101010101010101"
        "0101010101010101010101010101010101010101010101010101010101010101010101010101010101ffdb0043010101"
        "010101010101010101010101010101010101010101010101010101010101010101010101010101010101010101010101"
        "0101010101010101010101010101ffc00011080008001003011100021101031101ffc400140001000000000000000000"
        "00000000000009ffc40014100100000000000000000000000000000000ffc40016010101010000000000000000000000"
        "00000b090affc40014110100000000000000000000000000000000ffda000c03010002110311003f0017d29dbf810e55"
        "01afbfffd9"
    )
    rgba = png(2, 1, 8, 6, bytes([0, 255, 0, 0, 255, 0, 10, 20, 128]))
    return {
        "empty": b"",
        "rgba": rgba,
        "rgb": png(1, 2, 8, 2, bytes([0, 1, 2, 3, 1, 4, 5, 6])),
        "palette": png(3, 1, 2, 3, bytes([0, 24]), chunk(b"PLTE", bytes(range(9))) + chunk(b"tRNS", bytes([255, 9]))),
        "grey16": png(1, 2, 16, 0, bytes([0, 18, 52, 2, 171, 205])),
        "interlaced": png(2, 2, 8, 0, bytes([0, 1, 0, 2, 0, 3, 4]), interlace=1),
        "cut": rgba[:-20],
        "huge": png(2**31 - 1, 2**31 - 1, 8, 6, b""),
        "no_palette": png(1, 1, 8, 3, bytes(2)),
        "short_rows": png(2, 2, 8, 6, bytes(9)),
        "jpeg": jpeg,
        "jpeg_cut": jpeg[:-30],
        "jpeg_head": b"\xff\xd8\xff\xe0\0\x10JFIF\0\1\1\0\0\1\0\1\0\0\xff\xc0\0\x0b\x08\0\1\0\1\1\1\x11\0\xff\xd9",
        "jpeg_end": b"\xff\xd8\xff\xd9",
    }


if __name__ == "__main__":
    known = {f.__name__: f for f in (safetensors, torch_rng, torch_file, adamw, solvers, h5, corpus)}
    if not sys.argv[1:] or any(name not in known for name in sys.argv[1:]):
        sys.exit(__doc__)
    for name in sys.argv[1:]:
        known[name]()
