extends Reference
# Boxes to cast rays at.

const FeatureTable = preload("res://addons/bots/feature_table.gd")
const Rays = preload("res://addons/bots/rays.gd")


static func build(root: Viewport, rays: Dictionary) -> void:
	for each in rays["boxes"]:
		var body = Area.new() if each["group"] == "lava" else StaticBody.new()
		var shape := BoxShape.new()
		shape.extents = Vector3(each["half"][0], each["half"][1], each["half"][2])
		var collision := CollisionShape.new()
		collision.shape = shape
		body.add_child(collision)
		body.translation = Vector3(each["middle"][0], each["middle"][1], each["middle"][2])
		body.add_to_group(each["group"])
		body.name = each["group"]
		root.add_child(body)


static func cast(root: Viewport, rays: Dictionary) -> Dictionary:
	var table := FeatureTable.new()
	for feature in rays["features"]:
		feature["size"] = int(feature["size"])
	var fault := table.read(rays["features"])
	var caster := Rays.new()
	var set_up := caster.setup(table, rays["classes"])
	var eye := Transform(Basis(Vector3.UP, deg2rad(rays["heading_deg"])), Vector3(0, 1.2, 0))
	var own := [root.get_node("own")]
	var space := root.get_world().direct_space_state
	var everything := PoolIntArray(range(table.n_queries))
	return {
		"fault": fault, "ok": set_up["ok"], "wrong_classes": caster.setup(table, ["nothing"])["code"],
		"again": caster.setup(table, rays["classes"])["ok"], "all": Array(caster.cast(space, eye, everything, own)),
		"one": Array(caster.cast(space, eye, PoolIntArray([1]), own)),
		"none": Array(caster.cast(space, eye, PoolIntArray(), own))}
