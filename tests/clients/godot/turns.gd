extends Reference
# Turns with given numbers at a real server, and every error on the way.

const BotClient = preload("res://addons/bots/bot_client.gd")
const FeatureTable = preload("res://addons/bots/feature_table.gd")
const Forms = preload("forms.gd")


static func play(play: Dictionary) -> Dictionary:
	var client := BotClient.new()
	client.connect_to("127.0.0.1", int(play["port"]))
	client.hello()
	var table: FeatureTable = client.welcome["table"]
	var started := client.start(int(play["count"]), {"seeds": Forms.ints(play["seeds"]), "budgets_us": play["budgets_us"]})
	var bots: Array = started["bots"]
	var frames := []
	var errors := []
	for inputs in play["frames"]:
		var frame := int(inputs["frame"])
		var free := Forms.rows(inputs["free"], bots.size())
		var asked := _begun_and_polled(client, bots, frame, free)
		var acquired: Array = asked["asked"].duplicate()
		var failed := []
		for i in range(bots.size()):
			var fails: bool = inputs["fails"] and acquired[i].size() > 0
			failed.append([acquired[i][0]] if fails else [])
			acquired[i] = Array(acquired[i]).slice(1, acquired[i].size()) if fails else acquired[i]
		var values := _values(table, acquired, Forms.rows(inputs["costly"], bots.size()))
		if frame == int(play["errors_at"]):
			errors = _errors(client, bots, frame, free, acquired, values)
			errors.append(JSON.print(client.query(bots, frame, free, {"rewards": _quarters(bots)})) == JSON.print(asked))
		var options := {"failed": failed} if inputs["fails"] else {}
		var acted := client.act(bots, frame, acquired, values, options)
		if frame == int(play["errors_at"]):
			errors.append(JSON.print(client.act(bots, frame, acquired, values, options)) == JSON.print(acted))
		frames.append(_seen(asked, acted))
	errors.append(client.stop(bots)["count"])
	client.close()
	return {"frames": frames, "errors": errors, "late": client.n_late}


# The form that never waits; a second request meanwhile is refused and changes nothing.
static func _begun_and_polled(client: BotClient, bots: Array, frame: int, free: Array) -> Dictionary:
	client.begin_query(bots, frame, free, {"rewards": _quarters(bots)})
	var busy: String = client.begin_stop(bots)["code"]
	var reply = client.poll()
	while reply == null:
		OS.delay_usec(100)
		reply = client.poll()
	return reply if busy == "BUSY" else {"ok": false}


static func _errors(client: BotClient, bots: Array, frame: int, free: Array, acquired: Array, values: Array) -> Array:
	var none := []
	var nothing := []
	for _bot in bots:
		none.append(PoolIntArray())
		nothing.append(PoolRealArray())
	var high := free.duplicate(true)
	high[0][0] = 1e9
	var other := free.duplicate(true)
	other[0][0] += 0.5
	return Forms.codes([
		client.query([bots[0] + (1 << 40)], frame + 1, [free[0]]),
		client.query(bots, frame - 1, free),
		client.query(bots, frame, other, {"rewards": _quarters(bots)}),
		client.query(bots, frame + 1, high),
		client.query(bots, frame, [free[0]]),
		client.query(bots, frame, free, {"reward": _quarters(bots)}),
		client.act(bots, frame + 1, acquired, values),
		client.act(bots, frame, none, nothing),
		client.act(bots, frame, acquired, nothing),
		client.start(1 << 16),
		client.start(1, {"seeds": [0.5]}),
	])


static func _seen(asked: Dictionary, acted: Dictionary) -> Dictionary:
	var places := []
	var actions := StreamPeerBuffer.new()
	for row in asked["asked"]:
		places.append(Array(row))
	for row in acted["actions"]:
		for number in row:
			actions.put_float(number)
	return {
		"asked": places, "cost_us": Forms.shown(asked["cost_us"]), "actions": actions.data_array.hex_encode(),
		"reasons": Array(acted["reasons"]), "turns": acted["turns"], "frame": acted["frame"]}


static func _values(table: FeatureTable, acquired: Array, costly: Array) -> Array:
	var rows := []
	for i in range(acquired.size()):
		var row := PoolRealArray()
		for place in acquired[i]:
			var at := 0
			for before in range(place):
				at += table.costly[before]["size"]
			for j in range(table.costly[place]["size"]):
				row.append(costly[i][at + j])
		rows.append(row)
	return rows


static func _quarters(bots: Array) -> Array:
	var rewards := []
	for _bot in bots:
		rewards.append(0.25)
	return rewards
