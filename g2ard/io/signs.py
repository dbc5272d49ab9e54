"""Signs by which files of other programs are recognised: first bytes, words and names, and what to do."""

# ruff: noqa: E501

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from fnmatch import fnmatch
from functools import wraps
from pathlib import Path
from typing import NamedTuple, ParamSpec, TypeVar

from g2ard.errors import InputError

_HEAD = 1 << 16  # bytes of a file, and of a member of an archive, to look into
_ZIP = b"PK\3\4"
_GZIP = b"\x1f\x8b"
PHOTOS = (b"\xff\xd8\xff", b"\x89PNG\r\n", b"RIFF", b"II*\0", b"MM\0*")  # first bytes of photos

Given = ParamSpec("Given")
Returned = TypeVar("Returned")


class Sign(NamedTuple):
    """A kind of file.

    Args:
        what: what it is, and who writes it.
        todo: what to do instead of reading it.
        starts: first bytes, of which one must be there; none is required without them.
        words: words that the head must hold: also names within a .zip, and what is packed.
        names: patterns of file names in small letters, separated by blanks, of which one must fit.
        reads: suffix of the format, if it is read.
        poses: whether it holds poses of photos.
        at: byte at which the first bytes are.
        unless: suffixes of formats that are packed like this.
    """

    what: str
    todo: str = ""
    starts: tuple[bytes, ...] = ()
    words: tuple[bytes, ...] = ()
    names: str = "*"
    reads: str = ""
    poses: bool = False
    at: int = 0
    unless: tuple[str, ...] = ()

    def error(self, path: Path) -> InputError:
        return InputError(f"is {self.what}", path=path, hint=self.todo or None)

    def fits(self, path: Path, head: bytes) -> bool:
        """Return whether a file with this head is of this kind; `head` is in small letters."""
        starts = tuple(start.lower() for start in self.starts) or b""
        if not head[self.at :].startswith(starts) or path.suffix.lower() in self.unless:
            return False
        own = path.name.lower()
        named = any(fnmatch(own, name) for name in self.names.split())
        return named and all(word.lower() in head for word in self.words)


_SAVED = "give the .ply that the trainer exports"
_HIDDEN = "its Gaussians are in neural networks beside it: export a .ply with the program that trained them"
_UNPACK = "unpack it and give the file or folder in it"
MESH = "sample points with colours on it (CloudCompare, MeshLab), then `g2ard lift` them"
_FILM = "take photos from it (`ffmpeg -i VIDEO -r 2 photos/%04d.jpg`), and estimate their poses with COLMAP"
SCAN = "export the point cloud with its colours as .ply, .las or .e57"
_COLMAP = "export the cameras there for COLMAP, as a folder with cameras.txt and images.txt"
_REGISTER = "`g2ard register --poses` reads it; other commands need a lens per photo"
_NERF = "`ns-export gaussian-splat --load-config config.yml --output-dir out` writes a .ply"
_GRUT = "train or resume with `export_ply.enabled=true`, which writes a .ply"
_GSPLAT = "`gsplat.export_splats`, or training with --save_ply, writes a .ply"
_INRIA = "give point_cloud/iteration_N/point_cloud.ply, which the trainer saves beside it"
_EDITOR = "open it in the editor, and export the scene as .ply"
_LINK = "download the file that it links to, or export the scene where the page was made"
_LAS = "convert the .las or .laz that it was made from, or export one of it"
_SAVETXT = (
    "of x y z red green blue in rows, `numpy.savetxt('cloud.xyz', array)` makes a table to lift"
)
_PATH = "a path has no photos: give views with `render --views`, such as transforms.json or g2ard's .json"
_EUROC = "`evo_traj euroc FILE --save_as_tum` converts it, and `g2ard register --poses` reads that"


def _own(suffix: str, start: bytes, *words: bytes) -> Sign:
    return Sign(f"a {suffix} file", "", (start,), words, reads=suffix)


def _poses(
    what: str,
    *words: bytes,
    starts: tuple[bytes, ...] = (),
    names: str = "*",
    todo: str = _COLMAP,
) -> Sign:
    return Sign(what, todo, starts, words, names, poses=True)


_CAPTURE = "a table of cameras of RealityCapture (RealityScan)"
_PIX4D = "cameras of Pix4D"

_AS_TEXT = b"changed by a transfer as text"  # what `_head` adds to binary files all of whose line ends are CR LF
AGAIN = "get it again as binary (FTP: binary mode; git: `*.ply binary` in .gitattributes)"

_UNFINISHED = "*.crdownload *.part *.partial *.download *.opdownload *.aria2 *.!ut *.filepart"

SIGNS = (
    Sign("an unfinished download", "wait until it is complete, or download it again", names=_UNFINISHED),
    Sign("damaged by a transfer as text, which made each line end CR LF", AGAIN, words=(_AS_TEXT,)),
    Sign("a pointer of Git LFS, not the file itself", "`git lfs pull` gets it", (b"version https://git-lfs",)),
    Sign("a viewer's page with a scene inside (SuperSplat)", _EDITOR, (b"<!doctype html", b"<html"), (b"supersplat",)),
    Sign("an HTML page, not the file itself", _LINK, (b"<!doctype html", b"<html")),
    Sign("an HTML page, not the file itself", _LINK, (b"<?xml",), (b"<html",)),
    Sign("a network of Scaffold-GS or a relative", _HIDDEN, names="color_mlp.pt cov_mlp.pt opacity_mlp.pt"),
    Sign("a checkpoint of nerfstudio", _NERF, (_ZIP,), (b"data.pkl", b"gauss_params")),
    Sign("a checkpoint of 3dgrut", _GRUT, (_ZIP,), (b"data.pkl", b"features_albedo")),
    Sign("a checkpoint of gsplat", _GSPLAT, (_ZIP,), (b"data.pkl", b"splats")),
    Sign("a checkpoint of nerfstudio", _NERF, names="step-*.ckpt"),
    Sign("a checkpoint of 3dgrut", _GRUT, names="ckpt_last.pt"),
    Sign("a checkpoint of gsplat", _GSPLAT, names="ckpt_*.pt"),
    Sign("a checkpoint of INRIA's trainer", _INRIA, names="chkpnt*.pth"),
    Sign("a checkpoint of a training (PyTorch)", _SAVED, (_ZIP,), (b"data.pkl",)),
    Sign("a checkpoint of a training", _SAVED, names="*.pt *.pth *.ckpt *.pkl *.safetensors"),
    Sign("a project of SuperSplat", _EDITOR, (_ZIP,), (b"document.json",)),
    Sign("a project of SuperSplat", _EDITOR, names="*.ssproj"),
    Sign("a file of anchors of Octree-GS", _HIDDEN, (b"ply",), (b"f_anchor_feat", b"extra_level")),
    Sign("a file of anchors of Scaffold-GS", _HIDDEN, (b"ply",), (b"f_anchor_feat",)),
    Sign("a file of anchors of Scaffold-GS or a relative", _HIDDEN, (b"ply",), (b"f_offset_",)),
    Sign("a quantised scene of reduced-3dgs", "export it without quantisation", (b"ply",), (b"element codebook",)),
    Sign("a glTF packed by meshopt", "export it without meshopt (gltfpack without -c)", words=(b"_meshopt_compression",)),
    Sign("a glTF packed by Draco", "export it without Draco", words=(b"KHR_draco_mesh_compression",)),
    Sign("a file of NumPy arrays", _SAVED, (_ZIP,), (b".npy",)),
    Sign("an Office document", "save the table as .csv", (_ZIP,), (b"[Content_Types].xml",)),
    _own(".sog", _ZIP, b"meta.json"),
    Sign("an OpenUSD file", starts=(_ZIP,), words=(b".usd",), reads=".usdz"),
    _own(".spz", _GZIP, b"NGSP"),
    _own(".spz", b"NGSP"),
    Sign("a .ply file", starts=(b"ply\n", b"ply\r"), reads=".ply"),
    _own(".glb", b"glTF"),
    _own(".ksplat", b"\0\1\0\0"),
    _own(".las", b"LASF"),
    Sign("an .e57 file", starts=(b"ASTM-E57",), reads=".e57"),
    Sign("an OpenUSD file", starts=(b"PXR-USDC", b"#usda"), reads=".usdc"),
    _own(".pcd", b"# .PCD"),
    Sign("an archive (zip)", _UNPACK, (_ZIP, b"PK\5\6"), unless=(".sog", ".usdz")),
    Sign("an archive (gzip)", _UNPACK, (_GZIP,), unless=(".spz",)),
    Sign("an archive", _UNPACK, (b"7z\xbc\xaf\x27", b"Rar!\x1a", b"\x28\xb5\x2f\xfd", b"\xfd7zXZ", b"BZh"), unless=(".spz",)),
    Sign("an archive (tar)", _UNPACK, (b"ustar",), at=257),
    Sign("an archive", _UNPACK, names="*.zip *.7z *.rar *.tar *.gz *.tgz *.zst *.xz *.bz2"),
    _poses("Metashape's file of cameras", b"<chunk", b"<camera ", starts=(b"<?xml", b"<document")),
    _poses("a project of Metashape", names="*.psx *.psz"),
    _poses(_CAPTURE, b"name,x,y,", b"heading,pitch,roll"),
    _poses(_CAPTURE, b"name,x,y,", b"yaw,pitch,roll"),
    _poses(_CAPTURE, b"name,x,y,", b"omega,phi,kappa"),
    _poses("RealityCapture's (RealityScan's) pose of a photo", b"xcr:rotation"),
    _poses("a project of RealityCapture (RealityScan)", names="*.rcproj *.rsproj"),
    _poses("a file of cameras of Bundler", starts=(b"# Bundle file",)),
    _poses("a reconstruction of OpenSfM (OpenDroneMap)", b'"shots"', b'"cameras"', todo="`opensfm export_colmap` converts it"),
    _poses("a file of lenses of OpenDroneMap (OpenSfM)", b'"projection_type"', todo="`opensfm export_colmap` converts the project"),
    _poses("an exchange file of ContextCapture (Metashape writes it too)", b"<BlocksExchange"),
    _poses(_PIX4D, b"imagename", b"omega", b"kappa"),
    _poses(_PIX4D, names="*_pmatrix.txt *_calibrated_camera_parameters.txt"),
    _poses("a table of photos of Metashape", b"photoid", b"omega", b"kappa"),
    _poses("an orientation of MicMac", b"OrientationConique"),
    _poses("a reconstruction of VisualSFM", starts=(b"NVM_V3",)),
    _poses("a reconstruction of OpenMVG", b'"sfm_data_version"', todo="`openMVG_main_openMVG2Colmap` converts it"),
    _poses("a reconstruction of Meshroom (AliceVision)", b'"intrinsics"', b'"poses"', b'"views"'),
    _poses("a project of Meshroom (AliceVision)", names="*.mg"),
    _poses("a frame of 3D Scanner App", b'"cameraPoseARFrame"', todo="export a COLMAP folder or transforms.json there"),
    _poses("a trajectory of a SLAM program (TUM: time tx ty tz qx qy qz qw)", b"numbers:8 unit", todo=_REGISTER),
    _poses("a trajectory of a SLAM program (KITTI: 3×4 matrices)", b"numbers:12 rigid", todo=_REGISTER),
    _poses("a trajectory of EuRoC", b"#timestamp", b"q_rs_w", todo=_EUROC),
    Sign("a project of Postshot", _EDITOR, names="*.psht"),
    Sign("a project of CloudCompare", SCAN, (b"CCB",)),
    _poses("a project of Pix4D in OPF", b"application/opf-"),
    _poses("a table of photos of OpenSfM (OpenDroneMap)", b'"FeatureCollection"', b'"filename"', b'"translation"'),
    _poses("a capture of Record3D", b'"poses"', b'"K"', b'"fps"', todo="`ns-process-data record3d` converts it"),
    _poses("a capture of Record3D", names="*.r3d", todo="`ns-process-data record3d` converts it"),
    Sign("a camera path of nerfstudio's viewer", _PATH, words=(b'"camera_path"', b'"camera_to_world"')),
    Sign("a camera path of SuperSplat", _PATH, words=(b'"camera"', b'"poseSets"')),
    Sign("a point cloud of Potree", _LAS, words=(b'"octreeDir"',)),
    Sign("a point cloud of Potree", _LAS, words=(b'"hierarchy"', b'"stepSize"', b'"encoding"')),
    Sign("a point cloud in EPT (Entwine)", "`pdal translate ept.json cloud.laz` converts it", words=(b'"hierarchyType"', b'"schema"')),
    Sign("a part of a point cloud of Potree", _LAS, names="octree.bin hierarchy.bin"),
    Sign("a scene layer of ArcGIS (I3S)", SCAN, names="*.slpk *.i3s"),
    Sign("a drawing", SCAN, names="*.dxf *.dwg *.skp *.ifc *.step *.stp *.igs *.3dm"),
    Sign("a grid of heights (ESRI)", "`gdal2xyz.py` makes points of it, which have no colours", words=(b"ncols", b"nrows", b"cellsize")),
    Sign("an array of NumPy", _SAVETXT, names="[!p]*.npy p[!o]*.npy po[!s]*.npy pos[!e]*.npy poses.npy"),
    Sign("a database of features of COLMAP, without poses", "give the folder of a model, such as sparse/0", names="*.db"),
    Sign("a project of OpenMVS or MeshLab", _COLMAP, names="*.mvs *.mlp"),
    Sign("a camera path of instant-ngp", _PATH, words=(b'"path"', b'"aperture_size"')),
    Sign("a data set of another program", SCAN, names="*.h5 *.hdf5 *.parquet *.arrow *.tfrecord"),
    Sign("a tileset of 3D Tiles, for viewers such as CesiumJS", "give the scene that it was made of, or one of its .glb tiles", words=(b'"geometricError"', b'"root"')),
    Sign("a recording of sensors", SCAN, names="*.mcap *.db3 *.pcap *.pcapng *.svo *.svo2 *.rosbag *.lvx *.lvx2"),
    Sign("a hierarchy of Gaussians", "export a .ply with the program that trained it", names="*.hier *.hier_opt"),
    Sign("an LCC scene of XGRIDS", "`splat-transform scene.lcc scene.ply` (npm: @playcanvas/splat-transform) converts it", names="*.lcc"),
    Sign("a RAD scene of Spark", "convert the .ply, .spz or .sog that Spark built it from", names="*.rad"),
    Sign("a PTX scan of Leica", "`CloudCompare -O cloud.ptx -C_EXPORT_FMT PLY -SAVE_CLOUDS` converts it with its colours", names="*.ptx"),
    Sign("a scan or recording", SCAN, names="*.rcp *.rcs *.fls *.zfs *.rdbx *.bag"),
    Sign("a mesh", MESH, names="*.obj *.fbx *.stl *.dae *.3ds *.off *.b3dm *.blend *.drc"),
    Sign("a HEIC photo", "convert it to JPEG", (b"ftyphe", b"ftypmif1", b"ftypmsf1"), at=4),
    Sign("an AVIF photo", "convert it to PNG", (b"ftypavi",), at=4),
    Sign("an OpenEXR photo", "convert it to PNG", (b"v/1\1",)),
    Sign("a JPEG XL photo", "convert it to JPEG", (b"\0\0\0\x0cJXL ",)),
    Sign("a video", _FILM, (b"ftyp",), at=4),
    Sign("a video", _FILM, names="*.mp4 *.mov *.avi *.mkv *.insv *.webm"),
    Sign("a photo", starts=PHOTOS, reads=".jpg"),
    Sign("a PDF", "give the file that it describes", (b"%PDF",)),
)  # fmt: skip
"""All kinds; the first that fits counts."""


def sign_of(path: Path) -> Sign | None:
    """Return what a file is, or None if it is unknown or cannot be read."""
    with suppress(OSError):
        head = _head(path).lower()
        for sign in SIGNS:
            if sign.fits(path, head):
                return sign
    return None


def foreign(path: Path) -> Sign | None:
    """Return what a file is, if it is of another program and not read."""
    sign = sign_of(path)
    if sign is None or sign.reads:
        return None
    return sign


def _head(path: Path) -> bytes:
    """Return the head of a file, of what it packs, and the shape of a table of numbers."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if head.startswith(_ZIP):
        with suppress(Exception), zipfile.ZipFile(path) as bundle:
            names = bundle.namelist()
            head = head[:4] + "\n".join(names).encode(errors="replace")
            for name in names:
                if name.endswith("data.pkl"):
                    with bundle.open(name) as member:
                        head += member.read(_HEAD)
    elif head.startswith(_GZIP):
        with suppress(zlib.error):
            head = head[:4] + zlib.decompressobj(31).decompress(head, 4096)
    elif b"\0" not in head:
        head = head.removeprefix(b"\xef\xbb\xbf").lstrip()
        head += _shape(head)
    else:
        binary = head[head.index(0) :]
        if _FEWEST_LINES <= binary.count(b"\n") == binary.count(b"\r\n"):
            head += _AS_TEXT
    return head


_FEWEST_LINES = 4  # line ends in binary data that are not CR LF by chance


def _shape(head: bytes) -> bytes:
    """Return `numbers:N` for text in lines of N numbers, and whether these are poses."""
    lines = [
        line.split() for line in head.splitlines()[:20] if line.strip() and line[:1] not in b"#%"
    ]
    try:
        rows = [list(map(float, line)) for line in lines[:-1] or lines]
    except ValueError:
        return b""
    count = len(rows[0]) if rows else 0
    if any(len(row) != count for row in rows):
        return b""
    if count == 8 and all(_is_unit(row[4:]) for row in rows):
        return b"\nnumbers:8 unit"
    if count == 12 and all(_is_rigid(row) for row in rows):
        return b"\nnumbers:12 rigid"
    return b"\nnumbers:%d" % count


def _is_rigid(row: list[float]) -> bool:
    """Return whether the rows of a 3×4 matrix turn."""
    return all(_is_unit(row[at : at + 3]) for at in (0, 4, 8))


def _is_unit(vector: list[float]) -> bool:
    """Return whether a vector has a length of 1, as digits allow."""
    squared = sum(v * v for v in vector)
    return abs(squared - 1) < 0.02


def is_table(path: Path) -> bool:
    """Return whether a file is text in lines of three numbers or more."""
    _, _, shape = _head(path).rpartition(b"\nnumbers:")
    count = shape.split(b" ")[0]
    return count.isdigit() and int(count) >= 3


def explained(read: Callable[Given, Returned]) -> Callable[Given, Returned]:
    """Let errors of a function about a file of another program say what that file is."""

    @wraps(read)
    def reading(*given: Given.args, **named: Given.kwargs) -> Returned:
        try:
            return read(*given, **named)
        except InputError as error:
            path = error.path
            if path is None or not path.is_file():
                raise
            sign = foreign(path)
            if sign is None:
                raise
            raise sign.error(path) from error

    return reading
