"""The browser viewer: what it shows, compared with the map; a browser is not needed."""

from __future__ import annotations

import math
import re
import socket
import urllib.request
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gmmtorch.datasets import load
from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.live import viewer_scene
from gmmtorch.live.map_viewer import MapViewer, admits
from gmmtorch.mapping import Attributes, GaussianMap, Labels, Numbers, Query
from gmmtorch.report.ellipsoids import unit_sphere
from gmmtorch.scan import display_colours

pytest.importorskip("viser")
from viser_client import Client


@pytest.fixture(scope="module")
def maps() -> dict[int, tuple[GaussianMap, list[torch.Tensor]]]:
    """A map and its sensor paths by dimension."""
    torch.set_num_threads(1)
    found = {}
    for dim, name in ((2, "synthetic_building_2d"), (3, "synthetic_building")):
        scans = load(name, n_scans=3)
        built = GaussianMap()
        for scan in scans:
            built.insert(scan.select(torch.arange(scan.n_beams) % (1 if dim == 2 else 8) == 0))
        found[dim] = built, [torch.stack([scan.origin for scan in scans])]
    return found


@pytest.fixture
def viewer(maps) -> Iterator:
    made = MapViewer(*maps[3], port=8391)
    yield made
    made.stop()


# -- what is shown --------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_instances_are_the_two_sigma_ellipsoids(dim, maps):
    components = maps[dim][0].components()
    solid = viewer_scene.surfaces(components)
    wxyz, positions, scales = viewer_scene.instances(solid)
    sphere = unit_sphere(20)[0].numpy()
    for k in range(0, len(solid.means), 50):
        turn = Rotation.from_quat(wxyz[k, [1, 2, 3, 0]]).as_matrix()
        offset = (sphere * scales[k]) @ turn.T
        covariance = components.covariances[solid.rows[k]].numpy()
        # Points at two deviations have a squared Mahalanobis distance of 4; in 2D those of the equator.
        level = np.abs(offset[:, 2]) if dim == 2 else np.zeros(len(offset))
        flat = offset[:, :dim]
        distance = np.einsum("pi,ij,pj->p", flat, np.linalg.inv(covariance), flat)
        if dim == 3:
            np.testing.assert_allclose(distance, 4, rtol=1e-6)
        else:
            assert distance.max() <= 4 + 1e-6
            assert level.max() <= 0.011
    np.testing.assert_allclose(positions[:, :dim], components.means[solid.rows].numpy())


def test_surfaces_leave_out_free_ends_and_what_is_above(maps):
    components = maps[3][0].components()
    below = viewer_scene.surfaces(components, 1.0)
    wanted = (~components.max_range & (components.means[:, 2] <= 1.0)).nonzero()[:, 0]
    assert torch.equal(below.rows, wanted)


@pytest.mark.parametrize("by", viewer_scene.COLOURS)
def test_colours_follow_the_order_of_their_quantity(by, maps):
    components = maps[3][0].components()
    solid = viewer_scene.surfaces(components)
    colours = viewer_scene.colours(components, solid, by).rgb.astype(int)
    quantity = {
        "height": solid.means[:, 2],
        "support": components.support[solid.rows],
        "age": components.ids[solid.rows, 1],
        "uncertainty": viewer_scene.uncertainty(solid),
    }[by]
    low, high = int(quantity.argmin()), int(quantity.argmax())
    assert colours[high, 1] > colours[low, 1] + 100  # viridis: from violet to yellow, with rising green
    with pytest.raises(InvalidArgumentError, match="colour"):
        viewer_scene.colours(components, solid, "taste")


def test_the_least_certain_components_are_hidden(maps):
    components = maps[3][0].components()
    solid = viewer_scene.surfaces(components)
    for row, unsure in enumerate(viewer_scene.uncertainty(solid)[:20].tolist()):
        deviations = np.sqrt(np.linalg.svd(solid.covariances[row].numpy(), compute_uv=False))
        area = 2 * math.pi * deviations[0] * deviations[1]
        spacing = math.sqrt(area / float(components.support[solid.rows[row]]))
        assert unsure == pytest.approx(max(deviations[2], spacing), rel=1e-6)
    kept = viewer_scene.surfaces(components, hidden=0.3)
    assert len(kept.rows) == math.ceil(0.7 * len(solid.rows))
    left = ~torch.isin(solid.rows, kept.rows)
    assert viewer_scene.uncertainty(kept).max() <= viewer_scene.uncertainty(solid)[left].min()
    assert torch.equal(kept.rows, kept.rows.sort().values)
    share = viewer_scene.first_hidden(solid, 0.02) / 100
    shown = viewer_scene.surfaces(components, hidden=share)
    assert 0 < share < 1
    assert float(viewer_scene.uncertainty(shown).max()) <= 0.06
    assert viewer_scene.first_hidden(solid, 100.0) == 0


def test_slopes_are_the_change_of_the_colour_in_a_deviation(maps):
    components = maps[3][0].components()
    solid, k = viewer_scene.surfaces(components), len(components)
    slope = 0.02 * torch.randn(k, 3, 3, generator=torch.Generator().manual_seed(1)).double()
    none, middle = torch.zeros(k, 3, 3).double(), torch.full((k, 3), 0.5).double()
    known = Attributes({"colour": Numbers(torch.ones(k).double(), middle, slope, none)})
    found = viewer_scene.colours(replace(components, attributes=known), solid, "colour").slopes
    deviations, axes = np.linalg.eigh(solid.covariances.numpy())
    step = np.sqrt(deviations.clip(0))[:, None, :] * axes
    for row in range(0, len(solid.rows), 7):
        for axis in range(3):
            change = slope[solid.rows[row]].numpy() @ step[row, :, axis]
            ends = [display_colours(torch.from_numpy(0.5 + sign * change)).numpy() for sign in (1, -1)]
            expected = np.abs(ends[0] - ends[1]) / 2  # the direction of an axis is free
            np.testing.assert_allclose(np.abs(found[row, axis]), expected, atol=1e-9)


def test_channels_of_the_map_colour_its_components(maps):
    components = maps[3][0].components()
    solid, k = viewer_scene.surfaces(components), len(components)
    none = torch.zeros(k, 3, 3).double()
    colour = torch.rand(k, 3, generator=torch.Generator().manual_seed(0)).double()
    share = torch.ones(k).double()
    share[solid.rows[0]] = 0
    heat = torch.arange(k).double()[:, None]
    labels = torch.nn.functional.one_hot(torch.arange(k) % 2, 2).double()
    attributes = Attributes(
        {
            "colour": Numbers(share, colour, none, none),
            "heat": Numbers(share, heat, none[:, :1], none[:, :1, :1]),
            "class": Labels(labels, torch.tensor([4, 9])),
        }
    )
    known = replace(components, attributes=attributes)
    assert viewer_scene.colour_choices(known) == (*viewer_scene.COLOURS, "colour", "heat", "class")
    found = viewer_scene.colours(known, solid, "colour")
    expected = (255 * display_colours(colour[solid.rows])).round().numpy()
    np.testing.assert_array_equal(found.rgb[1:], expected[1:])
    assert found.rgb[0].tolist() == [160, 160, 160]  # unknown
    assert found.ends is None
    shades = viewer_scene.colours(known, solid, "heat")
    assert int(shades.rgb[-1, 1]) > int(shades.rgb[1, 1]) + 100
    classes = viewer_scene.colours(known, solid, "class")
    assert [name for name, _ in classes.legend] == ["4", "9"]
    of_rows = {tuple(rgb) for rgb in classes.rgb[(solid.rows % 2 == 0).numpy()].tolist()}
    assert len(of_rows) == 1
    assert classes.legend[0][1] == "rgb({}, {}, {})".format(*of_rows.pop())
    with pytest.raises(InvalidArgumentError, match="colour='heat'"):
        viewer_scene.colours(components, solid, "heat")


def test_slice_has_the_occupancy_of_the_map_with_the_highest_y_first(maps):
    built, _ = maps[3]
    low, high = torch.tensor([0.0, 0.0, 0.0]), torch.tensor([8.0, 4.0, 3.0])
    view = viewer_scene.Frame(low, high, torch.zeros(3), 1.0, 1.2, math.inf)
    found = viewer_scene.occupancy_slice(built, 0.5, 1.2, view)
    assert found.pixels.shape == (8, 16, 4)
    assert (found.middle.tolist(), found.size) == ([4.0, 2.0, 1.2], (8.0, 4.0))
    for row, column in ((0, 3), (5, 0), (7, 15), (2, 9)):
        x, y = 0.25 + 0.5 * column, 3.75 - 0.5 * row
        theta = float(built.occupancy(np.array([[x, y, 1.2]]), 0.5)[0])
        alpha = int(found.pixels[row, column, 3])
        assert (alpha == 0) == (abs(theta - 0.5) < 0.02)
        if alpha:
            assert (alpha > 200) == (theta >= 0.5)


def test_first_hit_is_where_a_dense_walk_along_the_ray_enters_an_ellipsoid(maps):
    solid = viewer_scene.surfaces(maps[3][0].components())
    precision = torch.linalg.inv(solid.covariances)
    origin = torch.tensor([4.0, 4.0, 1.2], dtype=torch.float64)
    step = torch.arange(0, 12, 0.01, dtype=torch.float64)
    n_hits = 0
    for angle in (0.5, 1.5, 2.5, 3.5, 4.5, 5.5):
        direction = torch.tensor([np.cos(angle), np.sin(angle), -0.15], dtype=torch.float64)
        offset = (origin + step[:, None] * direction)[:, None] - solid.means
        inside = (torch.einsum("pki,kij,pkj->pk", offset, precision, offset) < 4).any(1)
        found = viewer_scene.first_hit(solid, origin, direction)
        if inside.any() and not inside[0]:
            n_hits += 1
            assert found == pytest.approx(float(step[inside.long().argmax()]), abs=0.011)
    assert n_hits >= 2


@pytest.mark.parametrize("dim", [2, 3])
def test_a_place_has_the_evidence_from_which_its_occupancy_follows(dim, maps):
    built, _ = maps[dim]
    known = built.components()
    position = known.means[~known.max_range][0]  # beams without a return give no hits
    theta, hits, misses = viewer_scene.place_at(built, position, 0.1)
    given = (torch.tensor(value).double() for value in (hits, misses))
    expected = Query([built.components()], built.query_options).rule.probability(*given, 0.1, dim)
    assert hits > 0
    assert theta == pytest.approx(float(expected))


# -- the page -------------------------------------------------------------------------------------


def n_drawn(viewer: MapViewer) -> int:
    """Number of ellipsoids in the scene."""
    parts = (node for name, node in viewer._nodes.items() if name.startswith("components/"))
    return sum(len(node.batched_positions) for node in parts)


def test_controls_change_the_scene_and_a_click_says_what_the_map_knows(viewer, maps):
    assert {"components", "paths"} == {name.partition("/")[0] for name in viewer._nodes}
    viewer._shape.value = "ellipsoids"
    viewer._redraw(viewer._draw_components)
    viewer._visible.value, viewer._height.value = True, 0.8
    viewer._redraw(viewer._draw_slice)
    assert viewer._nodes["slice"].position[2] == pytest.approx(0.8)
    n_all = n_drawn(viewer)
    viewer._cut.value = 1.0
    viewer._redraw(viewer._draw_components)
    n_below = n_drawn(viewer)
    assert 0 < n_below < n_all
    viewer._unsure.value = 50
    viewer._redraw(viewer._draw_components)
    assert 0 < n_drawn(viewer) < n_below
    assert "linear-gradient" in viewer._legend.content
    viewer._show_place((2.0, 2.0, 0.81), (0.0, 0.0, -1.0))
    theta = maps[3][0].occupancy(np.array([[2.0, 2.0, 0.8]]), 0.1)[0]
    assert "at (2.00, 2.00, 0.80) m" in viewer._place.content
    assert f"| occupancy θ | {theta:.3f} |" in viewer._place.content
    viewer._visible.value = False
    viewer._redraw(viewer._draw_slice)
    assert "slice" not in viewer._nodes


@pytest.mark.parametrize("shape", ["ellipsoids", "splats", "surfaces", "none"])
def test_other_shapes(shape, viewer):
    viewer._shape.value = shape
    viewer._redraw(viewer._draw_components)
    assert any(name.startswith("components") for name in viewer._nodes) == (shape != "none")
    assert ("components" in viewer._nodes) == (shape == "surfaces")


def test_html_is_one_file_without_references_to_a_network(viewer, tmp_path):
    text = viewer.save_html(tmp_path / "map.html").read_text(encoding="utf-8")
    assert not re.findall(r"https?:|//[a-z]+\.", text)
    with pytest.raises(InvalidArgumentError, match=r"must end in \.html"):
        viewer.save_html(tmp_path / "map.txt")


def test_a_growing_map_is_shown_from_its_first_components(maps):
    made = MapViewer(GaussianMap(), port=8393)
    try:
        assert not made._nodes
        assert len(set(made._colour.options)) == len(made._colour.options)  # or the page stays blank
        made.update(*maps[2])
        assert {"components", "paths", "slice"} <= {name.partition("/")[0] for name in made._nodes}
        assert not made._height.visible
    finally:
        made.stop()


def test_only_parts_with_changed_components_are_sent_again(viewer, maps):
    own = maps[3][0].components()
    rows = torch.arange(4 * len(own)) % len(own)
    ids = torch.stack([torch.zeros_like(rows), torch.arange(len(rows))], 1)
    many = replace(own.selected(rows), ids=ids)
    viewer.update(GaussianMap.of(many))
    before = {name: node for name, node in viewer._nodes.items() if name.startswith("components")}
    surface = viewer_scene.surfaces(many).rows
    assert len(before) == len(torch.unique(surface // 256)) > 2
    means = many.means.clone()
    means[surface[0]] += 0.01
    viewer.update(GaussianMap.of(replace(many, means=means)))
    changed = [name for name, node in before.items() if viewer._nodes[name] is not node]
    assert changed == [f"components/0-{int(surface[0]) // 256}"]
    viewer.update(GaussianMap.of(many.selected(torch.arange(256))))
    assert [name for name in viewer._nodes if name in before] == ["components/0-0"]


# -- who may see the page -------------------------------------------------------------------------


PORT = 8394
OWN, PROXY = f"127.0.0.1:{PORT}", "https://map.example.org"


@pytest.fixture(scope="module")
def guarded(maps) -> Iterator:
    made = MapViewer(*maps[2], port=PORT, origins=[PROXY])
    yield made
    made.stop()


def status_of(viewer, *headers: str) -> int:
    """The status of a request for the page with these headers, sent without a library that would add some."""
    with socket.create_connection(("127.0.0.1", viewer.server.get_port()), timeout=10) as connection:
        connection.sendall("\r\n".join(["GET / HTTP/1.1", *headers, "", ""]).encode())
        return int(connection.recv(64).split()[1])


@pytest.mark.parametrize(
    ("headers", "is_admitted"),
    [
        ([f"Host: {OWN}"], True),
        ([f"Host: localhost:{PORT}", f"Origin: http://localhost:{PORT}"], True),
        (["Host: localhost:9000", "Origin: http://localhost:9000"], True),  # through a tunnel of ssh
        (["Host: 192.168.1.7:8080"], True),
        (["Host: [::1]:8080", "Origin: http://[::1]:8080"], True),
        ([f"Host: {socket.gethostname()}:{PORT}"], True),
        (["Host: map.example.org", f"Origin: {PROXY}"], True),
        ([f"Host: {OWN}", f"Origin: {PROXY}"], True),
        (["Host: evil.example"], False),
        (["Host: evil.example", f"Origin: http://{OWN}"], False),
        (["Host: 127.0.0.1.evil.example:8080"], False),
        ([f"Host: {OWN}", "Origin: http://evil.example"], False),
        ([f"Host: {OWN}", f"Origin: {PROXY}.evil.example"], False),
        ([f"Host: {OWN}", "Origin: null"], False),
        ([f"Host: {OWN}", "Origin: http://127.0.0.1:1"], False),
        ([f"Host: {OWN}", "Host: evil.example"], False),
        ([f"Host: {OWN}", f"Origin: http://{OWN}", "Origin: http://evil.example"], False),
        (["Host: ]["], False),
        (["Host:"], False),
        ([], False),
    ],
)
def test_only_the_pages_own_addresses_are_answered(guarded, headers, is_admitted):
    assert status_of(guarded, *headers) == (200 if is_admitted else 403)


def test_a_foreign_page_gets_no_connection(guarded):
    """What each page in the user's browser could open, and the same from the map's own page."""
    from websockets.exceptions import InvalidStatus

    with Client(guarded.url, origin=guarded.url) as client:
        client.received(b"GuiFolderMessage")
    with Client(guarded.url) as client:  # a program
        client.received(b"GuiFolderMessage")
    for headers in ({"origin": "http://evil.example"}, {"additional_headers": {"Origin": "null"}}):
        with pytest.raises(InvalidStatus, match="403"):
            Client(guarded.url, **headers)


def test_origins_are_checked(maps):
    wrong = ["map.example.org", "ftp://map.example.org", "https://map.example.org/page", "http://[map"]
    for origin in [*wrong, "https://me@map.example.org", "http://map.example.org:99999", "https://:8080"]:
        with pytest.raises(InvalidArgumentError, match=r"origins=.* is not the origin of a page"):
            MapViewer(GaussianMap(), port=8395, origins=[origin])


def test_a_server_that_cannot_be_guarded_is_not_used(monkeypatch):
    import viser

    monkeypatch.setattr(viser, "ViserServer", lambda *_, **__: None)
    with pytest.raises(GmmTorchError, match="foreign pages"):
        MapViewer(GaussianMap(), port=8396)


def test_the_viewer_survives_a_thousand_connections(guarded):
    """They send nothing, or a part of a request; the page is served beside them, and after them."""
    kept = []
    try:
        for number in range(1000):
            kept.append(socket.create_connection(("127.0.0.1", PORT), timeout=10))
            if number % 2:
                kept[-1].sendall(b"GET / HTTP/1.1\r\nHost: ")
        assert status_of(guarded, f"Host: {OWN}") == 200
    finally:
        for connection in kept:
            connection.close()
    assert status_of(guarded, f"Host: {OWN}") == 200


def test_an_origin_with_the_default_port_is_that_without():
    for scheme, port in (("https", 443), ("http", 80)):
        sent, named = f"{scheme}://map.example.org", f"{scheme}://Map.example.org:{port}/"
        for host in ("127.0.0.1:8080", "map.example.org"):  # a proxy may keep the name of the page or not
            assert admits(host, sent, "127.0.0.1", [named])
    assert not admits("127.0.0.1", "https://map.example.org", "127.0.0.1", ["https://map.example.org:80"])


def test_the_address_of_an_ipv6_server_can_be_opened():
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("this machine has no IPv6")
    made = MapViewer(GaussianMap(), host="::1", port=8396)
    try:
        with urllib.request.urlopen(made.url, timeout=10) as page:
            assert page.status == 200
    finally:
        made.stop()
