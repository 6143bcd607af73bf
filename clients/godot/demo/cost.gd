extends SceneTree
# What rays and turns cost from GDScript on this machine: medians, in µs.
#
#   python -m server --bundle bundles/hard --tcp-port 8001
#   godot3-server --path clients/godot -s demo/cost.gd --port=8001

const Arena = preload("arena.gd")
const BotClient = preload("../addons/bots/bot_client.gd")
const Rays = preload("../addons/bots/rays.gd")

const CLASSES := ["nothing", "ground", "wall", "lava", "water"]
const REPEATS := 300

var _client := BotClient.new()
var _ticks := 0
var _own_usec := 0


func _initialize() -> void:
	var port := 8001
	for argument in OS.get_cmdline_args():
		if argument.begins_with("--port="):
			port = int(argument.split("=")[1])
	get_root().add_child(Arena.new())
	var reply := _client.connect_to("127.0.0.1", port)
	if reply["ok"]:
		reply = _client.hello()
	if not reply["ok"]:
		printerr("%s: %s" % [reply["code"], reply["detail"]])
		quit(1)


# The space knows its shapes from the second tick on.
func _iteration(_delta: float) -> bool:
	_ticks += 1
	if _ticks == 3 and _client.is_open():
		_measure_rays(_client.welcome["table"])
		for count in [1, 16, 64]:
			_measure_turns(count)
		_client.close()
		quit()
	return false


func _measure_rays(table) -> void:
	var rays := Rays.new()
	rays.setup(table, CLASSES)
	var by_range := {}
	for i in range(table.n_queries):
		var range_m := int(table.costly[i]["name"].right(14))
		by_range[range_m] = by_range.get(range_m, []) + [i]
	var space := get_root().get_world().direct_space_state
	var eye := Transform(Basis(), Vector3(0, 1.2, 0))
	for range_m in by_range:
		var asked := PoolIntArray(by_range[range_m])
		var alone := []
		var packed := []
		for _i in range(REPEATS):
			var began := OS.get_ticks_usec()
			for feature in asked:
				space.intersect_ray(eye.origin, eye.xform(rays._reach[feature]), [], 1, true, true)
			alone.append((OS.get_ticks_usec() - began) / float(asked.size()))
			began = OS.get_ticks_usec()
			rays.cast(space, eye, asked, [])
			packed.append((OS.get_ticks_usec() - began) / float(asked.size()))
		print("%3d m: intersect_ray %.1f us a ray, rays.gd %.1f" % [range_m, _median(alone), _median(packed)])


func _measure_turns(count: int) -> void:
	var table = _client.welcome["table"]
	var bots: Array = _client.start(count)["bots"]
	var free := []
	var zeros := []
	for _i in range(table.n_free):
		zeros.append(0.0)
	for _bot in bots:
		free.append(PoolRealArray(zeros))
	var own := []
	var network := []
	for frame in range(REPEATS):
		_own_usec = 0
		var asked := _timed(funcref(_client, "begin_query"), [bots, frame, free])
		var values := []
		for row in asked["asked"]:
			var numbers := []
			for _i in range(table.costly[0]["size"] * row.size()):
				numbers.append(0.0)
			values.append(PoolRealArray(numbers))
		var acted := _timed(funcref(_client, "begin_act"), [bots, frame, asked["asked"], values])
		own.append(float(_own_usec))
		network.append(asked["infer_us"] + acted["infer_us"])
	print("%2d bots: %.0f us of this client a turn of all, %.0f of the network" % [count, _median(own), _median(network)])
	_client.stop(bots)


# The reply to what is begun here. What this client does for it is counted, what it waits for is not.
func _timed(begin: FuncRef, arguments: Array) -> Dictionary:
	var began := OS.get_ticks_usec()
	begin.call_funcv(arguments)
	_own_usec += OS.get_ticks_usec() - began
	while true:
		OS.delay_usec(200)
		began = OS.get_ticks_usec()
		var reply = _client.poll()
		if reply != null:
			_own_usec += OS.get_ticks_usec() - began
			return reply
	return {}


func _median(values: Array) -> float:
	values.sort()
	return values[values.size() / 2]
