def test_a_scan_is_accepted_and_can_be_looked_at(live):
    answer = live.post_scan()
    scan_id = answer.json()["scan_id"]
    assert answer.status_code == 202
    assert answer.headers["location"] == f"/v1/scans/{scan_id}"
    scan = live.http.get(answer.headers["location"]).json()
    assert (scan["tree_id"], scan["state"], scan["views_total"]) == ("apple-7", "running", 3)
