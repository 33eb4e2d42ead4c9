"""Who may look, who may command, and that anybody may stop."""

import pytest
from live_service import BODY, problem, serving

from canopy_skel.errors import UsageError
from service.access_keys import reaches_others, read_key
from service.http.access import Access
from service.scan_client import RefusedError, ScanClient

KEY = "0123456789abcdef"
COMMANDS = ("/v1/scans", "/v1/plans", "/v1/rig:acknowledge", "/v1/scans/x:resume")


@pytest.fixture
def guarded(tmp_path):
    access = Access(names=frozenset({"rig-3.farm.example"}), key=KEY)
    with serving(tmp_path, access=access) as live:
        yield live


@pytest.mark.parametrize("path", ["/", "/readyz", "/v1/rig", "/v1/scans", "/metrics"])
def test_a_page_that_had_its_own_name_lead_here_reads_nothing(path, guarded):
    rebound = {"Host": "evil.example:8000", "Origin": "http://evil.example:8000"}
    refusal = problem(guarded.http.get(path, headers=rebound), 421, "unknown_host")
    assert "'evil.example:8000' is not a name of this service" in refusal["detail"]


def test_a_page_that_had_its_own_name_lead_here_commands_nothing_but_may_stop(tmp_path):
    with serving(tmp_path) as live:
        rebound = {"Host": "evil.example", "Origin": "http://evil.example"}
        for path in COMMANDS:
            problem(live.http.post(path, json=BODY, headers=rebound), 421, "unknown_host")
        assert live.rig.specs == []
        assert live.http.post("/v1/rig:stop", headers=rebound).status_code == 200
        assert live.rig.stops == 1


@pytest.mark.parametrize(
    "host",
    [
        "localhost",
        "LOCALHOST:8000",
        "127.0.0.1",
        "192.168.0.7:80",
        "[::1]:8000",
        "Rig-3.farm.example",
    ],
)
def test_the_names_of_the_service_and_addresses_are_let_in(host, guarded):
    assert guarded.http.get("/v1/rig", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize("host", ["", "127.0.0.1.evil.example", "[::1", "rig-3", "2130706433", "@"])
def test_other_names_are_not(host, guarded):
    answer = guarded.http.get("/v1/rig", headers={"Host": host})
    assert answer.status_code in (400, 421)


@pytest.mark.parametrize("path", COMMANDS)
@pytest.mark.parametrize("sent", [None, f"Bearer {KEY}x", f"Basic {KEY}", "Bearer", "Bearer \xe9"])
def test_commands_need_the_key(path, sent, guarded):
    headers = {} if sent is None else {"Authorization": sent.encode("latin-1")}
    answer = guarded.http.post(path, json=BODY, headers=headers)
    problem(answer, 401, "key_required")
    assert answer.headers["WWW-Authenticate"] == "Bearer"
    assert KEY not in answer.text
    assert guarded.rig.specs == []


def test_looking_and_stopping_need_none(guarded):
    for path in ("/", "/readyz", "/v1/rig", "/v1/scans"):
        assert guarded.http.get(path).status_code == 200
    assert guarded.http.post("/v1/rig:stop").status_code == 200
    assert guarded.rig.stops == 1


def test_a_client_with_the_key_commands(guarded):
    with ScanClient(guarded.url, key=KEY) as client:
        scan_id = client.start(BODY, key="once")
        assert client.cancel(scan_id).state == "cancelled"
    with ScanClient(guarded.url) as client, pytest.raises(RefusedError, match="key is required"):
        client.start(BODY, key="again")


def test_the_schema_says_that_commands_take_a_key(guarded):
    paths = guarded.http.get("/openapi.json").json()["paths"]
    assert paths["/v1/scans"]["post"]["security"] == [{"HTTPBearer": []}]
    assert "security" not in paths["/v1/rig:stop"]["post"]
    assert "security" not in paths["/v1/scans"]["get"]


def test_a_key_is_read_without_the_space_around_it(tmp_path):
    (tmp_path / "key").write_text(f"  {KEY}\n")
    assert read_key(tmp_path / "key") == KEY


@pytest.mark.parametrize(
    "content",
    [b"", b"short", b"two words of some length", b"\xff" * 20, b"line\nafter line of text"],
)
def test_what_cannot_be_a_key_is_refused_and_says_how_to_make_one(content, tmp_path):
    (tmp_path / "key").write_bytes(content)
    with pytest.raises(UsageError, match=r"holds no key.*openssl rand -hex 32"):
        read_key(tmp_path / "key")


def test_a_key_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"no key file .*openssl rand -hex 32"):
        read_key(tmp_path / "key")


@pytest.mark.parametrize(
    ("host", "others"),
    [
        ("127.0.0.1", False),
        ("127.3.0.9", False),
        ("::1", False),
        ("localhost", False),
        ("0.0.0.0", True),
        ("::", True),
        ("192.168.0.7", True),
        ("rig-3", True),
    ],
)
def test_where_others_can_reach_the_service(host, others):
    assert reaches_others(host) is others
