// Where three.js puts the joints of BVH files and the nodes of glTF files, and their faces:
//
//     node three_positions.mjs FOLDER-OF-THREE FILE ...    writes FILE.three.json beside each
//
// Times and the animation of a glTF file, and whether it has a face, are read from FILE.times.json.

import { readFileSync, writeFileSync } from 'node:fs';
import { dirname, join } from 'node:path';
import { pathToFileURL } from 'node:url';

const [ three, ...files ] = process.argv.slice( 2 );
const load = ( path ) => import( pathToFileURL( join( three, path ) ).href );
globalThis.self = globalThis;
globalThis.ProgressEvent ??= class extends Event {};
const { AnimationMixer, LoopOnce, Vector3 } = await load( 'build/three.module.js' );
const { BVHLoader } = await load( 'examples/jsm/loaders/BVHLoader.js' );
const { GLTFLoader } = await load( 'examples/jsm/loaders/GLTFLoader.js' );

function positions( root, clip, nodes, times ) {

	const mixer = new AnimationMixer( root );
	if ( clip ) {

		const action = mixer.clipAction( clip ).setLoop( LoopOnce );
		action.clampWhenFinished = true;
		action.play();

	}

	return times.map( ( time ) => {

		mixer.setTime( time );
		root.updateMatrixWorld( true );
		return nodes.map( ( node ) => node.getWorldPosition( new Vector3() ).toArray() );

	} );

}

// Weights of the mesh with the face's morph targets, by name; without pictures and skins.
async function faceOf( file, animation, times ) {

	const json = withoutMeshes( file, [ 'meshes' ] );
	const { scene, animations } = await new GLTFLoader().parseAsync( JSON.stringify( json ), '' );
	const mixer = new AnimationMixer( scene );
	const action = mixer.clipAction( animations[ animation ] ).setLoop( LoopOnce );
	action.clampWhenFinished = true;
	action.play();
	const mesh = scene.getObjectsByProperty( 'isMesh', true ).find( ( each ) => each.morphTargetDictionary?.jawOpen >= 0 );
	const face = Object.fromEntries( Object.keys( mesh.morphTargetDictionary ).map( ( name ) => [ name, [] ] ) );
	for ( const time of times ) {

		mixer.setTime( time );
		for ( const name in face ) face[ name ].push( mesh.morphTargetInfluences[ mesh.morphTargetDictionary[ name ] ] );

	}

	return face;

}

function ofBvh( file ) {

	const { skeleton, clip } = new BVHLoader().parse( readFileSync( file, 'utf8' ) );
	const joints = skeleton.bones.filter( ( bone ) => bone.name !== 'ENDSITE' );

	// Two tracks a joint. Bound by id: names are cut at blanks, and the mixer reads signs in them.
	clip.tracks.forEach( ( track, i ) => {

		track.name = joints[ i >> 1 ].uuid + track.name.slice( track.name.lastIndexOf( '.' ) );

	} );

	const times = Array.from( clip.tracks[ 0 ].times );
	const fps = times.length > 1 ? ( times.length - 1 ) / times[ times.length - 1 ] : null;
	return { fps, frames: positions( skeleton.bones[ 0 ], clip, joints, times ) };

}

// The JSON of a file with its arrays in it, without meshes and pictures, which Node.js cannot decode.
function withoutMeshes( file, more = [] ) {

	const content = readFileSync( file );
	const isBinary = content.toString( 'latin1', 0, 4 ) === 'glTF';
	const end = isBinary ? 20 + content.readUInt32LE( 12 ) : content.length;
	const found = JSON.parse( content.toString( 'utf8', isBinary ? 20 : 0, end ) );
	const kept = [ 'asset', 'scene', 'scenes', 'nodes', 'animations', 'accessors', 'bufferViews', 'buffers', ...more ];
	const json = Object.fromEntries( kept.filter( ( key ) => key in found ).map( ( key ) => [ key, found[ key ] ] ) );
	for ( const node of json.nodes ) for ( const key of [ 'skin', 'camera', 'extensions', ...( json.meshes ? [] : [ 'mesh' ] ) ] ) delete node[ key ];
	for ( const mesh of json.meshes ?? [] ) for ( const primitive of mesh.primitives ) delete primitive.material;
	for ( const buffer of json.buffers ) {

		if ( buffer.uri?.startsWith( 'data:' ) ) continue;
		const data = buffer.uri ? readFileSync( join( dirname( file ), decodeURIComponent( buffer.uri ) ) ) : content.subarray( end + 8 );
		buffer.uri = 'data:application/octet-stream;base64,' + data.toString( 'base64' );

	}

	return json;

}

async function ofGltf( file ) {

	const { animation, times, face } = JSON.parse( readFileSync( file + '.times.json' ) );
	const json = withoutMeshes( file );
	const { scene, animations, parser } = await new GLTFLoader().parseAsync( JSON.stringify( json ), '' );
	const nodes = await parser.getDependencies( 'node' );
	const names = json.nodes.map( ( node ) => node.name ?? '' );
	const frames = positions( scene, animations[ animation ], nodes, times );
	return { names, frames, face: face ? await faceOf( file, animation, times ) : null };

}

for ( const file of files ) {

	const found = file.endsWith( '.bvh' ) ? ofBvh( file ) : await ofGltf( file );
	writeFileSync( file + '.three.json', JSON.stringify( found ) );

}
