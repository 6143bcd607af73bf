"""A store behind a real server: versions are activated and rolled back while bots play, and nothing else happens."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from bot_runtime.bundle import Bundle
from protocol.client import BotClient
from protocol.errors import BadBundle, NoBot, NoBundle
from protocol.resuming import ResumingClient
from server.catalogue import Catalogue
from server.listing import in_memory
from server.serving import Serving
from server.servings import Servings
from server.store import Store
from server.worker import Worker
from tests.bundles import make_bundle, rehash
from tests.server.serving import HttpAnswer, Served, http_request, play, same, serve

ADMIN, TOKEN = "the-operators-token", "the-engines-token"
WAIT_S = 60.0
"""For any answer: these tests must not fail because a machine is busy. Longer where a process is started."""
VERIFIED_WITHIN_S = 300.0


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three versions of one bundle and one of another."""
    folder = tmp_path_factory.mktemp("made")
    for version in range(1, 4):
        make_bundle(folder / "tiny" / str(version), seed=version, name="tiny")
    make_bundle(folder / "other" / "7", seed=9, name="other", context_length=1)
    return folder


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "store"))


@pytest.fixture
def settings(store: Path, tmp_path: Path) -> dict[str, Any]:
    for name, token in (("admin", ADMIN), ("token", TOKEN)):
        (tmp_path / name).write_text(token + "\n")
    tokens = {"admin_token_file": tmp_path / "admin", "token_file": tmp_path / "token"}
    return {"store": store, "frame_deadline_s": WAIT_S, **tokens}


@pytest.fixture
def served(settings: dict[str, Any], tmp_path: Path) -> Iterator[Served]:
    with serve(None, tmp_path / "s", **settings) as running:
        yield running


def admin(served: Served, path: str, body: Any = None, token: str | None = ADMIN) -> HttpAnswer:
    headers = {"Content-Type": "application/json"} | ({} if token is None else {"Authorization": f"Bearer {token}"})
    address, content = served.addresses["http"], json.dumps(body or {})
    return http_request(address, "POST", f"/v1/bundles/{path}", content, headers, timeout_s=VERIFIED_WITHIN_S)


def listed(served: Served, token: str = TOKEN) -> dict[str, Any]:
    headers = {"Authorization": f"Bearer {token}"}
    answer = http_request(served.addresses["http"], "GET", "/v1/bundles", headers=headers, timeout_s=WAIT_S)
    assert answer.status == 200
    return {entry["name"]: entry for entry in json.loads(answer.body)}


def code(answer: HttpAnswer) -> tuple[int, str]:
    return answer.status, json.loads(answer.body)["code"]


def hello(served: Served, bundle: str | None = "tiny", door: str = "unix") -> BotClient:
    client = BotClient(served.addresses[door], timeout_s=WAIT_S)
    client.hello(token=TOKEN, bundle=bundle)
    return client


def episode(served: Served, bundle: str) -> Any:
    """What a bot of this version does, alone."""
    with hello(served, bundle) as client:
        return play(client, client.welcome.features, client.start(1, seeds=[5]), range(12))


def test_versions_are_exchanged_while_bots_play_and_rolled_back(served: Served) -> None:
    with hello(served) as old, hello(served) as idle, hello(served, "tiny@3") as pinned:
        table = old.welcome.features
        assert old.welcome.bundle_version == 3  # nothing was recorded: the highest
        bots = old.start(1, seeds=[5])
        first_half = play(old, table, bots, range(6))
        idle.stop(idle.start(2))
        changed = admin(served, "tiny/activate", {"version": 1})
        assert changed.status == 200, changed.body
        assert json.loads(changed.body)["active"]["version"] == 1
        assert json.loads(changed.body)["previous"]["version"] == 3
        second_half = play(old, table, bots, range(6, 12))
        assert same([*first_half, *second_half], episode(served, "tiny@3"))
        new = play(idle, table, idle.start(1, seeds=[5]), range(12))
        assert idle.welcome.bundle_version == 1
        assert same(new, episode(served, "tiny@1"))
        assert not same(new, [*first_half, *second_half])
        pinned.start(1)
        assert pinned.welcome.bundle_version == 3
        states = {version["version"]: version["state"] for version in listed(served)["tiny"]["versions"]}
        assert states == {1: "active", 2: "stored", 3: "held"}
        assert listed(served)["tiny"]["versions"][2]["bots"] == 2
        assert [version["precision"] for version in listed(served)["tiny"]["versions"]] == ["fp32", None, "fp32"]
    assert json.loads(admin(served, "tiny/rollback").body)["active"]["version"] == 3
    assert json.loads(admin(served, "tiny/rollback").body)["active"]["version"] == 1


def test_what_was_activated_survives_a_restart_and_damage_to_it_does_not(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    with serve(None, tmp_path / "s", **settings) as served:
        assert admin(served, "tiny/activate", {"version": 2}).status == 200
    with serve(None, tmp_path / "s", **settings) as served:
        assert (listed(served)["tiny"]["active"], listed(served)["tiny"]["previous"]) == (2, 3)
        assert json.loads(admin(served, "tiny/rollback").body)["active"]["version"] == 3
    make_bundle(settings["store"] / "tiny" / "3", seed=11, name="tiny")
    with pytest.raises(BadBundle, match="versions never change"), serve(None, tmp_path / "s", **settings):
        pytest.fail("it started")


def test_bad_bundles_are_refused_and_what_was_serving_goes_on(served: Served, store: Path) -> None:
    action = store / "tiny" / "1" / "action.onnx"
    action.write_bytes(action.read_bytes()[:-1] + b"\0")
    make_bundle(store / "tiny" / "4", name="renamed")
    (store / "tiny" / "5").mkdir()
    wrong = make_bundle(store / "tiny" / "6", name="tiny", seed=6)
    golden = dict(np.load(wrong / "golden.npz"))
    np.savez(wrong / "golden.npz", **{**golden, "actions": golden["actions"] + 0.5})
    rehash(wrong)
    with hello(served) as client:
        bots, before = client.start(1, seeds=[5]), (store / "tiny" / "active.json").read_bytes()
        played = play(client, client.welcome.features, bots, range(6))
        for version, said in ((1, "sha256"), (4, "renamed"), (5, "manifest.json"), (6, "golden")):
            refused = admin(served, "tiny/activate", {"version": version})
            assert code(refused) == (422, "BAD_BUNDLE")
            assert said in json.loads(refused.body)["detail"]
        assert code(admin(served, "tiny/activate", {"version": 2, "sha256": "0" * 64})) == (422, "BAD_BUNDLE")
        assert code(admin(served, "tiny/activate", {"version": 3, "sha256": "0" * 64})) == (422, "BAD_BUNDLE")
        played += play(client, client.welcome.features, bots, range(6, 12))
    assert same(played, episode(served, "tiny@3"))
    assert listed(served)["tiny"]["active"] == 3
    assert (store / "tiny" / "active.json").read_bytes() == before


def test_requests_that_make_no_sense_change_nothing(served: Served) -> None:
    for name in ("none", "TINY", "tiny%00", "..", "%2e%2e"):
        assert code(admin(served, f"{name}/activate", {"version": 1})) == (404, "NO_BUNDLE")
    assert code(admin(served, "..%2Fstore%2Ftiny/activate", {"version": 1})) == (404, "NO_ROUTE")
    assert code(admin(served, "tiny/activate", {"version": 9})) == (404, "NO_BUNDLE")
    assert code(admin(served, "tiny/rollback")) == (404, "NO_BUNDLE")
    for body in ({}, {"version": 0}, {"version": "1"}, {"version": 1, "x": 1}, [], {"version": 1, "sha256": "a"}):
        assert code(admin(served, "tiny/activate", body or {"": 1})) == (422, "BAD_SCHEMA")
    assert code(admin(served, "tiny/activate", "x" * 5000)) == (413, "TOO_LARGE")
    headers = {"Content-Type": "text/plain", "Authorization": f"Bearer {ADMIN}"}
    answer = http_request(served.addresses["http"], "POST", "/v1/bundles/tiny/activate", b'{"version": 1}', headers)
    assert code(answer) == (415, "UNSUPPORTED_MEDIA_TYPE")
    assert listed(served)["tiny"]["active"] == 3


def test_only_the_admin_token_changes_anything(
    served: Served, settings: dict[str, Any], bundle: Path, tmp_path: Path
) -> None:
    for token in (None, "", TOKEN, ADMIN[:-1], "é"):
        for path in ("tiny/activate", "tiny/rollback", "none/activate"):
            assert code(admin(served, path, {"version": 1}, token)) == (401, "UNAUTHORIZED")
    assert listed(served, ADMIN) == listed(served)
    for headers in ({}, {"Authorization": "Bearer x"}):
        assert http_request(served.addresses["http"], "GET", "/v1/bundles", headers=headers).status == 401
    del settings["admin_token_file"]
    with serve(None, tmp_path / "t", **settings) as without:
        assert code(admin(without, "tiny/activate", {"version": 1}, "")) == (401, "UNAUTHORIZED")
        assert code(admin(without, "tiny/activate", {"version": 1}, None)) == (401, "UNAUTHORIZED")


def test_one_folder_is_listed_and_cannot_be_exchanged(bundle: Path, settings: dict[str, Any], tmp_path: Path) -> None:
    del settings["store"]
    with serve(bundle, tmp_path / "t", **settings) as served:
        (entry,) = listed(served).values()
        (version,) = entry["versions"]
        assert (entry["active"], version["state"], version["version"]) == (None, "active", None)
        assert code(admin(served, "tiny/activate", {"version": 1})) == (404, "NO_BUNDLE")
        with hello(served, "tiny") as client:
            assert client.welcome.bundle_version is None
            assert client.welcome.bundle_sha256 == version["sha256"]


def test_several_bundles_are_served_by_name(served: Served) -> None:
    with BotClient(served.addresses["tcp"]) as client, pytest.raises(NoBundle, match="other, tiny"):
        client.hello(token=TOKEN)
    for door in ("http", "tcp", "unix"):
        with hello(served, "other", door) as client:
            assert (client.welcome.bundle, client.welcome.context_length) == ("other", 1)
            play(client, client.welcome.features, client.start(2), range(3))


def test_signatures_are_required_where_keys_are_given(settings: dict[str, Any], store: Path, tmp_path: Path) -> None:
    author, public = Ed25519PrivateKey.generate(), tmp_path / "author.pem"
    public.write_bytes(author.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    settings["signing_key"] = (public,)
    with pytest.raises(BadBundle, match=r"manifest\.sig"), serve(None, tmp_path / "s", **settings):
        pytest.fail("it started")
    for version in (store / "tiny" / "3", store / "tiny" / "2", store / "other" / "7"):
        (version / "manifest.sig").write_bytes(author.sign((version / "manifest.json").read_bytes()))
    stranger = Ed25519PrivateKey.generate().sign((store / "tiny" / "1" / "manifest.json").read_bytes())
    with serve(None, tmp_path / "s", **settings) as served:
        assert code(admin(served, "tiny/activate", {"version": 1})) == (422, "BAD_BUNDLE")
        (store / "tiny" / "1" / "manifest.sig").write_bytes(stranger)
        assert code(admin(served, "tiny/activate", {"version": 1})) == (422, "BAD_BUNDLE")
        assert admin(served, "tiny/activate", {"version": 2}).status == 200
        versions = listed(served)["tiny"]["versions"]
        assert [version["state"] for version in versions] == ["stored", "active", "stored"]
        assert len(versions[1]["signed_by"]) == 16


def test_connections_that_hold_on_to_old_versions_do_not_fill_the_memory(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    with serve(None, tmp_path / "s", **settings, max_loaded=3) as served, hello(served), hello(served, "other"):
        assert admin(served, "tiny/activate", {"version": 1}).status == 200
        with hello(served):
            refused = admin(served, "tiny/activate", {"version": 2})
            assert (code(refused), refused.headers["retry-after"]) == ((503, "NOT_READY"), "1")
            assert (listed(served)["tiny"]["active"], listed(served)["tiny"]["previous"]) == (1, 3)
        assert admin(served, "tiny/activate", {"version": 2}).status == 200


def test_the_listing_tells_int8_bundles() -> None:
    shipped = Bundle.load(Path(__file__).parents[2] / "bundles" / "hard-int8", replay=False)
    servings = Servings(8)
    servings.activate(Serving(shipped, max_bots=8))
    assert [version.precision for version in in_memory(servings)["hard-int8"].values()] == ["int8"]


def test_a_store_with_more_names_than_may_be_in_memory_is_not_opened(store: Path) -> None:
    worker = Worker(max_queue=1)
    try:
        with pytest.raises(ValueError, match="--max-loaded is 1, and the store has more names"):
            Catalogue(Store(store), Servings(8, max_loaded=1), worker, max_bots=8).open()
    finally:
        worker.close()


def test_a_client_without_bots_resumes_on_whatever_is_active(served: Served) -> None:
    with ResumingClient(served.addresses["unix"], timeout_s=WAIT_S) as client:
        client.hello(token=TOKEN, bundle="tiny")
        assert client.stop(client.start(2)) == 2
        assert admin(served, "tiny/activate", {"version": 1}).status == 200
        client._client._transport.close()
        bots = client.start(1)
        assert client.welcome.bundle_version == 1
        play(client, client.welcome.features, bots, range(3))


def test_bots_that_were_resumed_hold_their_version_and_the_next_ones_do_not(served: Served) -> None:
    with ResumingClient(served.addresses["unix"], timeout_s=WAIT_S) as client:
        client.hello(token=TOKEN, bundle="tiny")
        table, bots = client.welcome.features, client.start(1)
        play(client, table, bots, range(2))
        client._client._transport.close()
        play(client, table, bots, range(2, 4))
        assert admin(served, "tiny/activate", {"version": 1}).status == 200
        others = client.start(1)
        assert (client.resumed, client.welcome.bundle_version) == (1, 3)
        client.stop(np.concatenate([bots, others]))
        play(client, table, client.start(1), range(2))
        assert client.welcome.bundle_version == 1


def test_a_line_that_breaks_after_an_exchange_ends_its_bots_for_good(served: Served) -> None:
    """It was the last to hold the version that they began with."""
    with ResumingClient(served.addresses["unix"], timeout_s=WAIT_S) as client:
        client.hello(token=TOKEN, bundle="tiny")
        table, bots = client.welcome.features, client.start(1)
        play(client, table, bots, range(2))
        assert admin(served, "tiny/activate", {"version": 1}).status == 200
        client._client._transport.close()
        with pytest.raises(NoBot, match="another version is served now"):
            play(client, table, bots, range(2, 3))
