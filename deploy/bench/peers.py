#!/usr/bin/env python3
"""Measures terrafarm beside the programs that one would pick instead, on the same terrain.

    peers.py --peers FOLDER --terrafarm BINARY [--posts 4097] [--work DIR] [--all]

FOLDER holds one folder a peer (embree, voxelspace, lowerbound, povray, raster) and export.py,
which writes the peers' terrain as a GeoTIFF and their cameras as a flight. It is copied to
the work folder before anything in it is built. The peers render 1920x1080 through three
cameras; terrafarm imports the same posts and looks through the same cameras over flat ground,
as the peers have it. Rounds of all programs alternate; medians count.

Both sides are measured in millions of pixels per second of processor time: what else this
machine does hardly matters then. Ratios of one run can be quoted, absolute numbers less so.
Before anything is printed the share of pixels that show ground is compared with Embree's:
if they differ, the two sides look at different things.

Needs g++, Debian's gdal-bin and libembree-dev; with --all also povray and libosmesa6-dev.
Python 3, standard library only. Exit code 0 done, 1 a comparison failed, 2 could not run.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile

CAMERAS = ["low", "mid", "steep"]  # in the order of export.py
SIZE = "1920x1080"
# Two triangles a cell, as Embree has it, and a bilinear cell differ along silhouettes.
GROUND_SHARE_TOLERANCE = 0.005
OPTIMISED = ["-O3", "-march=native", "-std=c++17", "-pthread"]


class Failure(Exception):
    """What failed, on what, why."""


def run(command, folder, environment=None, accept=(0,)):
    """Standard output of a command that must succeed."""
    done = subprocess.run(command, cwd=folder, env=environment, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    if done.returncode not in accept:
        last = (done.stderr or done.stdout).strip().splitlines()[-3:]
        raise Failure(f"{' '.join(map(str, command))} ended with {done.returncode}: {' / '.join(last)}")
    return done.stdout


def cases(output):
    """The lines `case key=value ...` of a peer, as dictionaries."""
    lines = (line.split()[1:] for line in output.splitlines() if line.startswith("case "))
    return [dict(word.split("=", 1) for word in line if "=" in word) for line in lines]


class Bench:
    """The peers and terrafarm, built and ready for rounds."""

    def __init__(self, options, work):
        self.posts, self.all = options.posts, options.all
        self.methods = options.methods
        self.terrafarm = os.path.abspath(options.terrafarm)
        self.peers_given = os.path.abspath(options.peers)
        self.peers = os.path.join(work, "peers")
        self.work = work
        self.cache = os.path.join(work, f"cache-{options.posts}")
        self.environment = dict(os.environ, BENCH_CACHE=self.cache, LP_NUM_THREADS="0")
        self.speeds = {}  # (column, camera) -> millions of pixels per processor second, a round each
        self.facts = {}   # (fact, camera) -> value
        self.floor = {}   # mode -> ns per pixel, a round each
        self.wrong = []

    def build(self):
        shutil.copytree(self.source(), self.peers, dirs_exist_ok=True, copy_function=shutil.copyfile)
        for folder, _, _ in os.walk(self.peers):
            os.chmod(folder, 0o755)
        os.makedirs(self.cache, exist_ok=True)
        self.compile("embree", "embree_bench.cpp", "e3", "-lembree3")
        self.compile("voxelspace", "voxelspace.cpp", "voxelspace")
        self.compile("lowerbound", "lb.cpp", "lb")
        if self.all:
            self.compile("raster", "raster.cpp", "raster", "-lOSMesa")

    def source(self):
        if not os.path.isfile(os.path.join(self.peers_given, "export.py")):
            raise Failure(f"{self.peers_given} has no export.py; name the folder of the peers")
        return self.peers_given

    def compile(self, folder, source, program, *libraries):
        say(f"building {folder}")
        run(["g++", *OPTIMISED, source, "-o", program, *libraries], os.path.join(self.peers, folder))

    def import_terrain(self):
        say(f"exporting and importing {self.posts} x {self.posts} posts")
        run([sys.executable, "export.py", str(self.posts), self.cache], self.peers, self.environment)
        self.store = os.path.join(self.cache, "bench.terrain")
        run([self.terrafarm, "terrain", "import", "--force", f"bench_{self.posts}.tif", "-o", self.store],
            self.cache)
        self.flight = os.path.join(self.cache, "flight.csv")
        with open(os.path.join(self.cache, "cameras.csv")) as cameras, open(self.flight, "w") as flight:
            # export.py counts headings from grid north, a flight from true north.
            flight.write("# heading: grid\n" + cameras.read())

    def peer(self, folder, *command):
        return cases(run(["./" + command[0], *command[1:]], os.path.join(self.peers, folder), self.environment))

    def note(self, column, camera, speed):
        self.speeds.setdefault((column, camera), []).append(float(speed))

    def round(self):
        best = {}
        for flags in ["none", "robust"]:
            for case in self.peer("embree", "e3", str(self.posts), "grid", flags, "quick"):
                if case.get("res") != SIZE or case["shadow"] != "0" or case["threads"] != "1":
                    continue
                camera, speed = case["cam"], float(case["mrays_per_cpu_s"])
                self.facts[("ground", camera)] = float(case["hit"])
                if case["mode"].endswith("coh"):
                    best[camera] = max(best.get(camera, 0.0), speed)
        for camera, speed in best.items():
            self.note("Embree", camera, speed)
        self.voxelspace()
        for case in self.peer("lowerbound", "lb"):
            if case.get("threads") == "1":
                self.floor.setdefault(case["mode"], []).append(float(case["ns_per_pixel"]))
        self.ours()
        if self.all:
            self.rasterised()

    def voxelspace(self):
        best = {}
        for case in self.peer("voxelspace", "voxelspace", str(self.posts)):
            if case.get("res") == SIZE and case.get("threads") == "1":
                camera = case["cam"]
                best[camera] = max(best.get(camera, 0.0), float(case["mpix_per_cpu_s"]))
        for camera, speed in best.items():
            self.note("VoxelSpace", camera, speed)

    def rasterised(self):
        for case in self.peer("raster", "raster", str(self.posts)):
            if case.get("res") == SIZE:
                self.note("GL " + case["mode"], case["cam"], case["mpix_per_cpu_s"])

    def povray(self):
        """Once: it takes minutes, and is slower by orders of magnitude."""
        script = os.path.join(self.peers, "povray", "run.py")
        for case in cases(run([sys.executable, script, str(self.posts)], self.peers, self.environment)):
            if case.get("res") == SIZE and case["shadow"] == "0" and case["threads"] == "1":
                self.note("POV-Ray", case["cam"], case["mpix_per_cpu_s"])

    def ours(self):
        report = os.path.join(self.cache, "core.json")
        run([self.terrafarm, "bench", "core", "--flat", "--terrain", self.store, "--flight", self.flight,
             "--size", SIZE, "--methods", self.methods, "--repeats", "5", "--json", report],
            self.cache, accept=(0, 1))
        with open(report) as text:
            found = json.load(text)["cases"]
        for case in found:
            camera, method = CAMERAS[case["camera"]], case["method"]
            if case["outcome"] == "refused":
                self.facts[("refused", method, camera)] = case["why"]
                continue
            if case["outcome"] == "wrong":
                self.wrong.append(f"{method}, camera {camera}: {case['why']}")
            self.note(method, camera, case["mpix_per_cpu_s"])
            self.facts[("ours", method, camera)] = case["ground"]

    def check(self):
        """Both sides look at the same thing."""
        for camera in CAMERAS:
            theirs, ours = self.facts.get(("ground", camera)), self.facts.get(("ours", "exact", camera))
            if theirs is not None and ours is not None and abs(theirs - ours) > GROUND_SHARE_TOLERANCE:
                self.wrong.append(f"camera {camera}: {ours:.4f} of the pixels show ground, of Embree's {theirs:.4f}")

    def speed(self, column, camera):
        rounds = self.speeds.get((column, camera))
        return statistics.median(rounds) if rounds else None

    def table(self):
        columns = []
        for column, _ in self.speeds:
            if column not in columns:
                columns.append(column)
        ours = [method for method in self.methods.split(",") if method in columns]
        theirs = [column for column in columns if column not in ours]
        floor = self.floor_ns()
        head = ["camera", "floor ns/pixel"]
        head += [f"{name} Mpix/s" for name in theirs]
        for method in ours:
            head += [f"{method} Mpix/s", "x Embree", "x floor"]
        rows = []
        for camera in CAMERAS:
            embree = self.speed("Embree", camera)
            row = [camera, number(floor)]
            row += [number(self.speed(name, camera)) for name in theirs]
            for method in ours:
                speed = self.speed(method, camera)
                row += [number(speed), number(speed / embree if speed and embree else None),
                        number(1e3 / speed / floor if speed and floor else None)]
            rows.append(row)
        return head, rows

    def floor_ns(self):
        """The least that a pixel costs here: a load from memory and a store, coherent as a
        picture is, from the largest table measured."""
        gathers = {mode: ns for mode, ns in self.floor.items() if mode.startswith("coherent_gather")}
        size = lambda mode: int("".join(letter for letter in mode if letter.isdigit()) or 0)
        if not gathers:
            return None
        return statistics.median(gathers[max(gathers, key=size)])


def number(value):
    return "-" if value is None else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def say(text):
    print(text, file=sys.stderr, flush=True)


def show(head, rows):
    widths = [max(len(row[column]) for row in [head, *rows]) for column in range(len(head))]
    for row in [head, *rows]:
        print("  ".join(cell.rjust(width) for cell, width in zip(row, widths)))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", required=True, help="folder of the peers")
    parser.add_argument("--terrafarm", required=True, help="the program, a release build")
    parser.add_argument("--posts", type=int, default=4097, help="posts along a side [4097]")
    parser.add_argument("--work", help="folder to build in, kept [a temporary one]")
    parser.add_argument("--rounds", type=int, default=3, help="rounds of all programs [3]")
    parser.add_argument("--methods", default="exact,lod,column,frustum,voxel", help="ours, with commas")
    parser.add_argument("--all", action="store_true", help="POV-Ray and software OpenGL as well")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        bench = Bench(options, os.path.abspath(options.work or temporary))
        try:
            bench.build()
            bench.import_terrain()
            for number_of_round in range(options.rounds):
                say(f"round {number_of_round + 1} of {options.rounds}")
                bench.round()
            if bench.all:
                say("POV-Ray")
                bench.povray()
        except (Failure, OSError, KeyError, ValueError) as failure:
            print(f"peers.py: {failure}", file=sys.stderr)
            return 2
        bench.check()
        print(f"{options.posts} x {options.posts} posts, {SIZE}, one thread, flat ground, "
              f"median of {options.rounds} rounds; all speeds per second of processor time")
        show(*bench.table())
        for (fact, *where), why in bench.facts.items():
            if fact == "refused":
                print(f"{where[0]} refused camera {where[1]}: {why}")
        for wrong in dict.fromkeys(bench.wrong):
            print(f"peers.py: wrong: {wrong}", file=sys.stderr)
        return 1 if bench.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
